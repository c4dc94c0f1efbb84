"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.meta.fig5_ablations.run import FORMS
from benchmarks.race_plots import draw
from benchmarks.runner.records import Record

COLOURS = {
    "whole": "#1f6fb4",
    "centred variances": "#d1782a",
    "alpha not bounded": "#c0392b",
    "independent statistics": "#8a3fa8",
    "not decoupled": "#777777",
}


def plot(record: Record) -> Figure:
    """Rows: error over seconds of the race, over paths of the descents at length. A panel per form."""
    parts = [("ajar", record["methods"], 0, "seconds")]
    if "at length" in record:
        parts.append(("indirect-room, at length", record["at length"]["methods"], 1, "paths"))
    figure, axes = plt.subplots(len(parts), 2, figsize=(12, 4.2 * len(parts)), squeeze=False, layout="constrained")
    for row, (title, methods, column, unit) in zip(axes, parts, strict=True):
        for axis, form in zip(row, FORMS, strict=True):
            for name, colour in COLOURS.items():
                found = methods.get(f"{form}, {name}")
                if found:
                    draw(axis, found, column, colour, f"{name}, rate {found['rate']:g}: {found['final'][0]:.3f}")
            axis.set(title=f"{title}, {form}", xlabel=unit, ylabel="parameter error / initial", yscale="log")
            axis.legend(fontsize=7)
    return figure
