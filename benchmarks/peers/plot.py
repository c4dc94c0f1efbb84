"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Median error of the textures over processor seconds."""
    problems = record["problems"]
    figure, axes = plt.subplots(
        1, len(problems), figsize=(6.6 * len(problems), 3.8), layout="constrained", squeeze=False
    )
    for axis, (name, sides) in zip(axes[0], problems.items(), strict=True):
        for side, entry in sides.items():
            curves = [np.array([[0.0, 1.0], *run["curve"][1:]]).T for run in entry["runs"]]
            grid = np.linspace(0, min(curve[0, -1] for curve in curves), 100)
            axis.plot(grid, np.median([np.interp(grid, *curve) for curve in curves], axis=0), label=side)
        axis.set(xlabel="processor seconds", ylabel="error where seen / at the start", ylim=(0, None), title=name)
        axis.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure
