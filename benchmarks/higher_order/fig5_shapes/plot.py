"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Median loss over seconds, a panel per task."""
    tasks = record["tasks"]
    figure, axes = plt.subplots(1, len(tasks), figsize=(4.8 * len(tasks), 3.6), squeeze=False, layout="constrained")
    grid = np.linspace(0, record["settings"]["seconds"], 100)
    for axis, (name, task) in zip(axes[0], tasks.items(), strict=True):
        for method, found in task["methods"].items():
            curves = [np.interp(grid, *run["curve"]) for run in found["runs"]]
            axis.plot(grid, np.median(curves, axis=0), label=method)
        axis.set(xlabel="seconds", ylabel="loss / at the start", title=f"{name}: {task['numbers']} numbers")
    axes[0, 0].legend(fontsize=8)
    return figure
