"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.race_plots import draw
from benchmarks.runner.records import Record

COLOURS = {
    "Adam, 16 spp": "#e0a030",
    "Adam, 64 spp": "#a04010",
    "meta, 1 + 2": "#1f6fb4",
    "meta, 12 + 4": "#7fb2dd",
    "meta, 4 + 16": "#123f66",
    "meta, 1 + 2, walk": "#20b0b0",
    "coupled": "#1a8f4c",
    "coupled on rcv": "#8a3fa8",
}


def plot(record: Record) -> Figure:
    """Per problem: error over processor seconds and over samples."""
    entries = record["entries"]
    figure, axes = plt.subplots(len(entries), 2, figsize=(12, 4.2 * len(entries)), squeeze=False, layout="constrained")
    for row, (name, entry) in zip(axes, entries.items(), strict=True):
        for column, (axis, unit) in enumerate(zip(row, ("processor seconds", "paths"), strict=True)):
            for method, found in entry["methods"].items():
                label = f"{method}, rate {found['rate']:g}: {found['final'][0]:.3f}"
                draw(axis, found, column, COLOURS.get(method, "#555555"), label)
            axis.set(title=name, xlabel=unit, ylabel="parameter error / initial", yscale="log")
            if column:
                axis.set_xscale("log")
            else:
                axis.legend(fontsize=6)
    return figure
