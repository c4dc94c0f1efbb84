"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """One panel per problem and loss: error over seconds, median and range over seeds."""
    entries = record["entries"]
    rows = -(-len(entries) // 2)
    figure, axes = plt.subplots(rows, 2, figsize=(10, 3.2 * rows), squeeze=False, layout="constrained")
    colours = {"stock": "#888888", "plain": "#d1782a", "rcv": "#1f6fb4"}
    colours |= {"plain, denoised": "#8a55a8", "rcv, denoised": "#4a9a6a"}
    for axis, entry in zip(axes.flat, entries.values(), strict=False):
        for method, found in entry["methods"].items():
            grid = np.linspace(0, entry["seconds"], 100)
            curves = np.stack([np.interp(grid, *np.array([(0.0, 1.0), *run]).T) for run in found["runs"]])
            label = f"{method}, {found['spp']} spp, rate {found['rate']:g}"
            axis.plot(grid, np.median(curves, 0), color=colours[method], label=label)
            axis.fill_between(grid, curves.min(0), curves.max(0), color=colours[method], alpha=0.2, lw=0)
        axis.set(
            title=f"{entry['problem']}, {entry['loss']}",
            xlabel="seconds of the processor" if "processor" in entry else "seconds",
            ylabel="parameter error / initial",
            ylim=(0, None),
        )
        axis.legend(fontsize=7)
    for axis in axes.flat[len(entries) :]:
        axis.remove()
    return figure
