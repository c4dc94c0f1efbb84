"""Figure."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """Relative variance of the difference over the size of the step."""
    scenes = record["scenes"]
    figure, axes = plt.subplots(1, len(scenes), figsize=(4 * len(scenes), 3.5), layout="constrained", squeeze=False)
    for axis, (name, of) in zip(axes[0], scenes.items(), strict=True):
        for space, found in of.items():
            axis.loglog(record["settings"]["moves"], found["sum"], "--", label=f"{space}, sum")
            axis.loglog(record["settings"]["moves"], found["geometric"], label=f"{space}, geometric mean")
        axis.set(xlabel="step", title=name)
    axes[0, 0].set(ylabel="Var[F - H] / Var F")
    axes[0, 0].legend()
    return figure
