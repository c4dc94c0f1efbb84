"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record
from benchmarks.volumes.fig5_drift.run import LOSSES, METHODS


def plot(record: Record) -> Figure:
    """Distance over steps, a panel per loss and parameter."""
    keys = list(next(iter(record["drift"].values())))
    figure, axes = plt.subplots(len(LOSSES), len(keys), figsize=(5 * len(keys), 6), sharex=True, layout="constrained")
    for row, loss in zip(axes, LOSSES, strict=True):
        for number, (axis, key) in enumerate(zip(row, keys, strict=True)):
            for name in METHODS:
                curve = np.array(record["curves"][f"{loss}, {name}"])[:, number]
                steps = np.linspace(0, record["settings"]["steps"], len(curve))
                axis.plot(steps, curve, label=name, ls="-" if name.startswith("rcv") else "--")
            axis.axhline(0, color="black", lw=0.5)
            axis.set(title=f"{loss}: {key}", xlabel="step", ylabel="relative distance from the truth")
    axes[0][0].legend(fontsize=7)
    return figure
