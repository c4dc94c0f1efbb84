"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Median picture errors by problem and loss."""
    problems = record["problems"]
    losses = sorted({loss for of in problems.values() for loss in of})
    figure, axes = plt.subplots(1, len(losses), figsize=(5 * len(losses), 4), layout="constrained", squeeze=False)
    for axis, loss in zip(axes[0], losses, strict=True):
        names = [name for name in problems if loss in problems[name]]
        choices = list(problems[names[0]][loss])
        for number, choice in enumerate(choices):
            at = np.arange(len(names)) + 0.8 * (number - (len(choices) - 1) / 2) / len(choices)
            heights = [np.median(problems[name][loss][choice]["pictures"]) for name in names]
            axis.bar(at, heights, 0.7 / len(choices), label=choice)
        axis.set_xticks(range(len(names)), names, rotation=20)
        axis.set(title=loss, ylabel="picture error / at the start")
        axis.legend()
    return figure
