"""Figure."""

from __future__ import annotations

import matplotlib.pyplot as plt
from benchmarks.meta.fig5_ablations.run import ABLATIONS, FORMS
from benchmarks.runner.records import Record
from matplotlib.figure import Figure


def plot(record: Record) -> Figure:
    """Error over seconds, one panel per form."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.2), sharey=True, layout="constrained")
    for axis, form in zip(axes, FORMS, strict=True):
        for name, (_, colour) in ABLATIONS.items():
            found = record["methods"][f"{form}, {name}"]
            draw(axis, found, 0, colour, f"{name}, rate {found['rate']:g}: {found['final'][0]:.3f}")
        axis.set(title=f"ajar, {form}", xlabel="seconds", ylabel="parameter error / initial", yscale="log")
        axis.legend(fontsize=7)
    return figure
