"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record

COLOURS = {"Adam, 2 spp": "#e0a030", "Adam, 16 spp": "#a04010", "meta, deviation": "#1f6fb4", "meta, walk": "#20b0b0"}


def plot(record: Record) -> Figure:
    """Median and quartiles of the error along the descents; each rule's final error by its rate."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    for name, f in record["methods"].items():
        errors, share = np.array(f["errors"]), np.linspace(0.2, 1, len(f["errors"]))
        left.semilogy(share, errors[:, 1], color=COLOURS[name], label=f"{name}: {errors[-1, 1]:.3f}")
        left.fill_between(share, errors[:, 0], errors[:, 2], color=COLOURS[name], alpha=0.15, lw=0)
        right.loglog(*np.array(f["tried"]).T, "o-", color=COLOURS[name], label=name)
    left.set(xlabel="share of the descent", ylabel="error / initial")
    right.set(xlabel="learning rate", ylabel="final error / initial")
    left.legend(fontsize=7)
    right.legend(fontsize=7)
    return figure
