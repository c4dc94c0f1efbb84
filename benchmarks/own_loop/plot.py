"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

COLOURS = {"drjit": "#888888", "drjit, changed": "#1f6fb4", "torch": "#c9a27a", "torch, changed": "#d1782a"}


def plot(record: Record) -> Figure:
    """Error over time, one panel for each loss."""
    losses = record["losses"]
    figure, axes = plt.subplots(1, len(losses), figsize=(4.6 * len(losses), 3.2), layout="constrained", squeeze=False)
    for axis, (loss, entries) in zip(axes[0], losses.items(), strict=True):
        for name, entry in entries.items():
            end = min(history[-1][0] for history in entry["runs"])
            where = np.linspace(0, end, 60)
            values = [np.interp(where, *np.array([(0.0, record["start"]), *history]).T) for history in entry["runs"]]
            axis.plot(where, np.median(values, axis=0), color=COLOURS[name], label=f"{name}, {entry['spp']} spp")
            axis.fill_between(where, np.min(values, 0), np.max(values, 0), color=COLOURS[name], alpha=0.2, lw=0)
        axis.set(xlabel="seconds", ylabel="RMSE of the texture", title=f"{loss.upper()} loss", ylim=(0, None))
        axis.legend(frameon=False, fontsize=8)
    return figure
