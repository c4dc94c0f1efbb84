"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Median error over processor seconds, near starts above, far ones below."""
    problems = record["problems"]
    kinds = list(record["settings"]["starts"])
    size = (3.4 * len(problems), 2.6 * len(kinds))
    figure, axes = plt.subplots(len(kinds), len(problems), figsize=size, layout="constrained", squeeze=False)
    grid = np.linspace(0, record["settings"]["seconds"], 100)
    for column, (name, of) in enumerate(problems.items()):
        for row, kind in enumerate(kinds):
            axis = axes[row][column]
            for method, entry in of.get(kind, {"methods": {}})["methods"].items():
                curves = [np.interp(grid, *run["curve"]) for run in entry["runs"]]
                axis.plot(grid, np.median(curves, axis=0), label=method)
            axis.set(yscale="log", title=f"{name}, {kind}", xlabel="processor seconds", ylabel="error")
    axes[0][0].legend(fontsize="small")
    return figure
