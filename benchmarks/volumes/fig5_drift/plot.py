"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record
from benchmarks.volumes.fig5_drift.run import METHODS

STYLES = {
    "plain, 2 spp": ("#e8b04a", "--"),
    "plain, 4 spp": ("#d1782a", "--"),
    "plain, 16 spp": ("#8a4a1a", "--"),
    "debiased, 2 spp": ("#b03a3a", ":"),
    "rcv, 2 spp": ("#1f6fb4", "-"),
    "rcv, 4 spp": ("#7fb2dd", "-"),
}


def plot(record: Record) -> Figure:
    """Distance over steps, a panel per loss and parameter."""
    entry = record["descents"]["three-bodies"]
    keys = list(next(iter(entry["methods"].values()))["distance"])
    figure, axes = plt.subplots(len(METHODS), len(keys), figsize=(5 * len(keys), 6), sharex=True, layout="constrained")
    for row, (loss, methods) in zip(axes, METHODS.items(), strict=True):
        for number, (axis, key) in enumerate(zip(row, keys, strict=True)):
            for name in methods:
                if (found := entry["methods"].get(f"{loss}, {name}")) is None:
                    continue
                curve = np.array(found["curve"])[:, number]
                colour, line = STYLES[name]
                axis.plot(np.linspace(0, entry["steps"], len(curve)), curve, label=name, color=colour, ls=line)
            axis.axhline(0, color="black", lw=0.5)
            axis.set(title=f"{loss}: {key}", xlabel="step", ylabel="relative distance from the truth")
    axes[0][0].legend(fontsize=7)
    return figure
