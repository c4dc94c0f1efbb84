"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.landscape_plot import plot_landscape
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Loss and derivative against the factor."""
    figure, settings = plt.figure(figsize=(11, 7.5), layout="constrained"), record["settings"]
    plot_landscape(figure.subplots(2, 2), record, "the fog's extinction")
    words = f"mean of {settings['runs']} renders (bars: standard errors)"
    figure.suptitle(f"three-bodies, {settings['resolution']}², {words}")
    return figure
