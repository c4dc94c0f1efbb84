"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Final errors by samples per pixel."""
    tasks = record["tasks"]
    figure, axes = plt.subplots(1, len(tasks), figsize=(4.6 * len(tasks), 3.4), squeeze=False)
    for axis, (name, methods) in zip(axes[0], tasks.items(), strict=True):
        for method, entry in methods.items():
            counts = [int(count) for count in entry]
            values = np.array([[run["final"] for run in rows] for rows in entry.values()])
            (line,) = axis.plot(counts, np.median(values, axis=1), marker="o", label=method)
            axis.fill_between(counts, values.min(axis=1), values.max(axis=1), color=line.get_color(), alpha=0.12)
        axis.set(
            title=name, xscale="log", yscale="log", xlabel="samples per pixel", ylabel="final error of the parameters"
        )
    axes[0, 0].legend(fontsize=8)
    figure.set_layout_engine("constrained")
    return figure
