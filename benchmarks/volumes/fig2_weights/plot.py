"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

COLOURS = {"rcv": "#1f6fb4", "plain": "#d1782a"}


def plot(record: Record) -> Figure:
    """Weights, variance, and a panel for each parameter."""
    keys = list(record["errors"]["rcv"])
    figure = plt.figure(figsize=(12, 7), layout="constrained")
    grid = figure.add_gridspec(2, 6)
    axes = [figure.add_subplot(grid[0, 3 * n : 3 * n + 3]) for n in range(2)]
    axes += [figure.add_subplot(grid[1, 2 * n : 2 * n + 2]) for n in range(len(keys))]
    steps = np.arange(len(record["weight"]))
    low, median, high = np.array(record["weight_10_50_90"])
    axes[0].plot(steps, record["weight"], color=COLOURS["rcv"], label="mean")
    axes[0].plot(steps, median, color=COLOURS["rcv"], ls="--", label="median")
    axes[0].fill_between(steps, low, high, color=COLOURS["rcv"], alpha=0.15, lw=0, label="10th to 90th percentile")
    axes[0].set(title="control weight over pixels", xlabel="step", ylim=(0, 1.02))
    axes[0].legend(fontsize=8, loc="lower right")
    ratio, error = np.array(record["variance_ratio"]), np.array(record["variance_ratio_error"])
    axes[1].plot(steps, ratio, color=COLOURS["rcv"])
    axes[1].fill_between(steps, ratio - error, ratio + error, color=COLOURS["rcv"], alpha=0.2, lw=0)
    axes[1].axhline(1, color=COLOURS["plain"], lw=1)
    axes[1].set(title="variance / a plain render's", xlabel="step", yscale="log")
    for axis, key in zip(axes[2:], keys, strict=True):
        for method, colour in COLOURS.items():
            curves = np.array(record["errors"][method][key])
            axis.plot(steps, np.median(curves, axis=0), color=colour, label=method)
            axis.fill_between(steps, curves.min(axis=0), curves.max(axis=0), color=colour, alpha=0.15, lw=0)
        axis.set(title=f"error of {key.split('.')[0]}", xlabel="step", yscale="log")
        axis.legend(fontsize=8)
    settings = record["settings"]
    figure.suptitle(f"three-bodies, {settings['resolution']}², {settings['spp']} spp, L1, Adam at {settings['rate']:g}")
    return figure
