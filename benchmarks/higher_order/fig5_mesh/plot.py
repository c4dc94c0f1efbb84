"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Median loss over seconds."""
    figure, axis = plt.subplots(figsize=(5.5, 4), layout="constrained")
    grid = np.linspace(0, record["settings"]["seconds"], 100)
    for method, runs in record["methods"].items():
        axis.plot(grid, np.median([np.interp(grid, *run["curve"]) for run in runs], axis=0), label=method)
    title = f"sphere-to-mesh: {record['numbers']} numbers"
    axis.set(xlabel="seconds", ylabel="loss / at the start", yscale="log", title=title)
    axis.legend()
    return figure
