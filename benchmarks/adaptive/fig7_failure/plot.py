"""Figure."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from benchmarks.runner.records import Record
from matplotlib.figure import Figure

PROBLEMS = ("caustic", "plain-and-textured", "mirror-trio")


def plot(record: Record) -> Figure:
    """Reference, map from few paths, map from many."""
    stored = record["maps"]
    figure, axes = plt.subplots(len(PROBLEMS), 3, figsize=(9, 3.2 * len(PROBLEMS)), layout="constrained")
    for row, name in zip(axes, PROBLEMS, strict=True):
        row[0].imshow(np.clip(stored[f"{name}|reference"], 0, 1) ** (1 / 2.2))
        row[0].set_title(name)
        for axis, which in zip(row[1:], ("few", "many"), strict=True):
            axis.imshow(stored[f"{name}|{which}"], cmap="magma", norm="log")
            spp = FEW if which == "few" else record["settings"]["many"]
            ratio = record["variance"][name][which]["mean"]
            axis.set_title(f"{spp} paths a pixel: variance × {ratio:.2f}")
        for axis in row:
            axis.axis("off")
    return figure
