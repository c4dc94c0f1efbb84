"""Figure."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from benchmarks.runner.records import Record
from matplotlib.figure import Figure

CUTS: dict[str, dict[str, bool]] = {
    "plain": {},
    "aggregate": {"aggregate": True},
    "antithetic": {"antithetic": True},
    "baseline": {"baseline": True},
    "antithetic and baseline": {"antithetic": True, "baseline": True},
    "low-discrepancy": {"low_discrepancy": True},
    "all": {"aggregate": True, "antithetic": True, "baseline": True, "low_discrepancy": True},
    "all but low-discrepancy": {"aggregate": True, "antithetic": True, "baseline": True},
    "all but aggregate": {"antithetic": True, "baseline": True, "low_discrepancy": True},
}


def plot(record: Record) -> Figure:
    """Bars per problem and order."""
    problems = record["problems"]
    figure, axes = plt.subplots(1, len(problems), figsize=(4.6 * len(problems), 4), layout="constrained", sharey=True)
    for axis, (name, orders) in zip(axes, problems.items(), strict=True):
        for index, (order, cuts) in enumerate(orders.items()):
            values = [cuts[cut] for cut in CUTS if cut in cuts]
            axis.barh(np.arange(len(values)) + 0.27 * (index - 1), values, 0.25, label=order)
        axis.set_yticks(range(len(CUTS)), list(CUTS))
        axis.axvline(1.0, color="#888", lw=0.8)
        axis.set(title=name, xscale="log", xlabel="variance × evaluations over that of plain")
    axes[0].legend(fontsize=8)
    axes[0].invert_yaxis()
    return figure
