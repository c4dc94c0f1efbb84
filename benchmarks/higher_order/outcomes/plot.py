"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.internals import srgb
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """A column per task: start, outcomes, reference."""
    maps, errors = record["maps"], record["errors"]
    rows = ["start", *next(iter(errors.values())), "reference"]
    figure, axes = plt.subplots(
        len(rows), len(errors), figsize=(1.6 * len(errors), 1.65 * len(rows)), squeeze=False, layout="constrained"
    )
    for column, name in enumerate(errors):
        for row, kind in enumerate(rows):
            axis = axes[row, column]
            axis.imshow(srgb(maps[f"{name}|{kind}"]), interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            if row == 0:
                axis.set_title(name, fontsize=9)
            if column == 0:
                axis.set_ylabel(kind, fontsize=9)
    return figure
