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
    """Error over seconds, one panel per form."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), sharey=True, layout="constrained")
    for axis, form in zip(axes, FORMS, strict=True):
        for name, colour in COLOURS.items():
            found = record["methods"][f"{form}, {name}"]
            draw(axis, found, 0, colour, f"{name}, rate {found['rate']:g}: {found['final'][0]:.3f}")
        axis.set(title=f"ajar, {form}", xlabel="seconds", ylabel="parameter error / initial", yscale="log")
        axis.legend(fontsize=7)
    return figure
