"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

COLOURS = {
    "adam": "#d1782a",
    "meta 24 + 8, naive": "#7fb2dd",
    "meta 16 + 16": "#0b3c66",
    "meta 24 + 8": "#1f6fb4",
    "coupled": "#1a8f4c",
}


def plot(record: Record) -> Figure:
    """Left: the rate over the steps, with the spread of 20 runs; middle: RMSE; right: one run's gradient and its predicted deviation."""
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    horizon = str(record["settings"]["steps"][0])
    for method, colour in COLOURS.items():
        entry = record["methods"][method][horizon]
        runs = np.array(entry["runs"])
        axes[0].plot(runs.mean(0), color=colour, label=f"{method}, rate {entry['rate']:g}")
        axes[0].fill_between(np.arange(runs.shape[1]), runs.min(0), runs.max(0), color=colour, alpha=0.15, lw=0)
        axes[1].plot(entry["curve"], color=colour, label=f"{method}, rate {entry['rate']:g}")
    axes[0].axhline(0.5, color="k", ls=":", lw=1)
    axes[0].set(xlabel="step", ylabel="rate", ylim=(0.4, 0.75), title="mean and range of 20 runs")
    axes[1].set(xlabel="step", ylabel="RMSE of the rate", yscale="log", title=f"tuned for {horizon} steps")
    axes[0].legend(fontsize=8)
    for method in ("meta 24 + 8", "coupled"):
        entry, colour = record["methods"][method][horizon], COLOURS[method]
        g, s = np.array(entry["gradients"])[:200], np.array(entry["deviations"])[:200]
        axes[2].plot(g, color=colour, label=method)
        axes[2].fill_between(np.arange(len(g)), g - s, g + s, color=colour, alpha=0.2, lw=0)
    axes[2].plot(
        record["methods"]["adam"][horizon]["gradients"][:200], ".", ms=2, color="#d1782a", label="plain samples"
    )
    axes[2].set(xlabel="step", ylabel="gradient", ylim=(-6, 4), title="one run: estimate and predicted deviation")
    axes[2].legend(fontsize=8)
    return figure
