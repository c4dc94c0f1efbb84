"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Median error of the surface over processor seconds, of the problems where it is known."""
    known = {name: of["methods"] for name, of in record["problems"].items() if of["judged by"] == "surface"}
    figure, axes = plt.subplots(1, len(known), figsize=(5 * len(known), 4), layout="constrained", squeeze=False)
    grid = np.linspace(0, record["settings"]["seconds"], 100)
    for axis, (problem, methods) in zip(axes[0], known.items(), strict=True):
        for name, of in methods.items():
            axis.plot(grid, np.median([np.interp(grid, *run["curve"]) for run in of["runs"]], axis=0), label=name)
        axis.set(xlabel="processor seconds", ylabel="surface error / at the start", yscale="log", title=problem)
        axis.legend()
    return figure
