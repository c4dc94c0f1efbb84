"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.higher_order.table2.descents import GOALS
from benchmarks.higher_order.table2.methods import METHODS
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Per task: median error over time, in the image and in the parameters, log-log."""
    rows = record["tasks"]
    figure, axes = plt.subplots(len(rows), 2, figsize=(10, 2.9 * len(rows)), squeeze=False, layout="constrained")
    colour = dict(zip(["Mitsuba", *METHODS], plt.get_cmap("tab10")(range(10)), strict=False))
    for axis_row, (name, row) in zip(axes, rows.items(), strict=True):
        for axis, curve, what in zip(axis_row, ("image", "parameter"), ("image", "parameters"), strict=True):
            for method, entry in row["methods"].items():
                axis.plot(*entry["curves"][curve], color=colour[method], label=method)
            for goal in GOALS:
                axis.axhline(goal, color="#bbb", lw=0.6)
            axis.set(
                title=f"{name}: {what}", xscale="log", yscale="log", xlabel="seconds", ylabel="error / at the start"
            )
            axis.set(xlim=(3e-3, max(entry["seconds"] for entry in row["methods"].values())), ylim=(3e-4, 3))
        if len(row["methods"]) > 6 or name == next(iter(rows)):
            axis_row[0].legend(fontsize=6)
    return figure
