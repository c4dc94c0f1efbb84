"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.pixel_schemes import COLOURS
from benchmarks.race_plots import draw
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Error over time, and over samples."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, column, label in ((axes[0], 0, "seconds"), (axes[1], 1, "paths")):
        for name, entry in record["methods"].items():
            runs = {"runs": entry["runs"]["both"]}
            draw(axis, runs, column, COLOURS[name], f"{name}: {entry['final']['both'][0]:.3f}")
        axis.set(xlabel=label, ylabel="error / initial", yscale="log")
        axis.legend(fontsize=8)
    return figure
