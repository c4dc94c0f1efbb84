"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.higher_order.variance.run import CUTS
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Bars per problem and order."""
    problems = record["problems"]
    figure, axes = plt.subplots(1, len(problems), figsize=(4.6 * len(problems), 4), sharey=True, squeeze=False)
    for axis, (name, orders) in zip(axes[0], problems.items(), strict=True):
        for index, (order, cuts) in enumerate(orders.items()):
            values = [cuts[cut] for cut in CUTS if cut in cuts]
            axis.barh(np.arange(len(values)) + 0.27 * (index - 1), values, 0.25, label=order)
        axis.set_yticks(range(len(CUTS)), list(CUTS))
        axis.axvline(1.0, color="#888", lw=0.8)
        axis.set(title=name, xscale="log", xlabel="variance × evaluations over that of plain")
    axes[0, 0].legend(fontsize=8)
    axes[0, 0].invert_yaxis()
    figure.set_layout_engine("constrained")
    return figure
