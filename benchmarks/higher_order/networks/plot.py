"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Median error over seconds, a panel per task."""
    tasks = record["tasks"]
    figure, axes = plt.subplots(1, len(tasks), figsize=(3.6 * len(tasks), 4), squeeze=False, layout="constrained")
    for axis, (name, task) in zip(axes[0], tasks.items(), strict=True):
        grid = np.linspace(0, task["seconds"], 200)
        for method, entry in task["methods"].items():
            curves = [np.interp(grid, *run["curve"]) for run in entry["runs"]]
            axis.plot(grid, np.median(curves, axis=0), label=method)
        axis.set(title=name, xlabel="seconds", yscale="log")
        axis.set(ylabel="error of the poses / at the start")
        axis.legend()
    return figure
