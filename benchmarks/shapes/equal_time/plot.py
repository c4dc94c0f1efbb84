"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Median error of the surface over seconds."""
    figure, axes = plt.subplots(
        1, len(record["problems"]), figsize=(5 * len(record["problems"]), 4), layout="constrained", squeeze=False
    )
    grid = np.linspace(0, record["settings"]["seconds"], 100)
    for axis, (name, found) in zip(axes[0], record["problems"].items(), strict=True):
        for method, of in found.items():
            if "runs" in of:
                axis.plot(grid, np.median([np.interp(grid, *run["curve"]) for run in of["runs"]], axis=0), label=method)
        axis.set(xlabel="processor seconds", ylabel="surface error / at the start", yscale="log", title=name)
        axis.legend()
    return figure
