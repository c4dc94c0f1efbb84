"""Figure."""

import math

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Per problem, the error of both against time."""
    problems, seconds = record["problems"], record["settings"]["seconds"]
    columns = min(6, len(problems))
    rows = math.ceil(len(problems) / columns)
    figure, axes = plt.subplots(rows, columns, figsize=(2.6 * columns, 2.2 * rows), squeeze=False, layout="constrained")
    time = seconds * np.arange(11) / 10
    for axis, (name, entry) in zip(axes.flat, problems.items(), strict=False):
        axis.plot(time, [1.0, *entry["loop"]], color="0.5", label="stock loop, tuned")
        axis.plot(time, [1.0, *entry["auto"]], color="C1", label="auto, no option")
        if "fixed_point" in entry:
            axis.plot(time, [1.0, *entry["fixed_point"]], color="C0", ls=":", label="reference / rendering")
        axis.set(title=name, yscale="log", xlabel="seconds", ylabel="error / start")
    for axis in list(axes.flat)[len(problems) :]:
        axis.set_visible(False)
    axes[0, 0].legend(fontsize="small")
    return figure
