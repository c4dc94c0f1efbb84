"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record
from benchmarks.shapes.cameras.run import ASKED


def plot(record: Record) -> Figure:
    """The largest error of a start's cameras over processor seconds, median over starts: angles above, places below."""
    scenes = record["scenes"]
    figure, axes = plt.subplots(2, len(scenes), figsize=(3.6 * len(scenes), 5), layout="constrained", squeeze=False)
    grid = np.linspace(0, record["settings"]["seconds"], 100)
    for column, (scene, found) in enumerate(scenes.items()):
        for row, (what, asked) in enumerate(zip(("degrees", "% of the distance"), ASKED, strict=True)):
            axis = axes[row][column]
            for name, runs in found.items():
                curves = [np.interp(grid, run["curve"][0], run["curve"][1 + row]) for run in runs]
                axis.plot(grid, np.median(curves, axis=0), label=name)
            axis.axhline(asked, color="grey", linestyle=":", label="asked for")
            axis.set(yscale="log", ylabel=what, title=scene if row == 0 else "", xlabel="processor seconds")
    axes[0][0].legend(fontsize="small")
    return figure
