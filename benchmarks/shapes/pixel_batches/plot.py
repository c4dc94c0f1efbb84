"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Median error of the surface over processor seconds."""
    figure, axis = plt.subplots(figsize=(5, 4), layout="constrained")
    grid = np.linspace(0, record["settings"]["seconds"], 100)
    for name, of in record["methods"].items():
        axis.plot(grid, np.median([np.interp(grid, *run["curve"]) for run in of["runs"]], axis=0), label=name)
    axis.set(xlabel="processor seconds", ylabel="surface error / at the start", yscale="log")
    axis.legend()
    return figure
