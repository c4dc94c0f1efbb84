"""Figure."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """The image, two maps of pixel probabilities, and the variances."""
    maps = record["maps"]
    figure, axes = plt.subplots(1, 4, figsize=(16, 4), layout="constrained", width_ratios=(1, 1.15, 1.15, 1.3))
    axes[0].imshow(np.clip(maps["reference"], 0, 1) ** (1 / 2.2))
    axes[0].set_title("reference")
    for axis, name in zip(axes[1:3], ("loss", "adaptive"), strict=True):
        shown = axis.imshow(maps[name], cmap="magma", norm="log", vmin=0.1)
        axis.set_title(f"{name}, over uniform")
        figure.colorbar(shown, ax=axis)
    for axis in axes[:3]:
        axis.axis("off")
    entries = record["schemes"]
    axes[3].barh(list(entries), [e["variance"] for e in entries.values()], xerr=[e["error"] for e in entries.values()])
    axes[3].set(xscale="log", xlabel="variance of dL/d(roughness)")
    return figure
