"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.adaptive.equal_time.run import timed
from benchmarks.pixel_schemes import COLOURS
from benchmarks.race_plots import draw
from benchmarks.runner.records import Record

COLUMNS = 4
"""Axes side by side."""


def plot(record: Record) -> Figure:
    """Error over time, one axis per task."""
    entries = record["entries"]
    columns = min(len(entries), COLUMNS)
    rows = -(-len(entries) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(5 * columns, 4 * rows), squeeze=False, layout="constrained")
    for axis in axes.flat[len(entries) :]:
        axis.set_axis_off()
    for axis, (name, entry) in zip(axes.flat, entries.items(), strict=False):
        for method, runs in timed(entry["methods"], record["seconds_per_path"][name]).items():
            draw(axis, {"runs": runs}, 0, COLOURS[method], f"{method}: {entry['errors'][method][-1]:.3f}")
        axis.set(title=name, xlabel="seconds", ylabel="parameter error / initial", yscale="log")
        axis.legend(fontsize=7)
    return figure
