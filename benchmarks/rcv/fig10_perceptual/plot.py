"""Figure."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.derivative_bias import METHODS
from benchmarks.runner.records import Record

COLOURS = {"plain, 4 spp": "#e8b04a", "plain, 32 spp": "#b0581a", "rcv, 4 spp": "#1f6fb4"}


def plot(record: Record) -> Figure:
    """Derivatives and their biases above, descents below."""
    maps, found = record["maps"], record["bias"]["losses"]["perceptual"]
    figure = plt.figure(figsize=(13, 8.5), layout="constrained")
    halves: Any = figure.subfigures(2, 1)
    above, below = halves
    top = float(np.quantile(np.abs(maps["perceptual/reference"]), 0.98))
    pictures = {"converged": maps["perceptual/reference"]}
    for method in METHODS:
        pictures[f"{method}, one run"] = maps[f"perceptual/{method}"]
    for method in METHODS:
        pictures[f"{method}: bias, rms {found[method]['rms']:.2f}"] = maps[f"perceptual/{method}/bias"]
    drawn: Any = None
    axes = above.subplots(1, len(pictures))
    for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
        drawn = axis.imshow(picture, vmin=-top, vmax=top, cmap="RdBu_r")
        axis.set_title(title, fontsize=8)
        axis.axis("off")
    above.colorbar(drawn, ax=list(axes), label="∂L/∂pixel", shrink=0.5)
    above.suptitle("Derivative of the perceptual loss")
    for axis, error in zip(below.subplots(1, 2), ("features", "texture"), strict=True):
        for name, entry in record.get("methods", {}).items():
            for number, run in enumerate(entry["runs"][error]):
                points = np.array(run)
                steps = np.linspace(0, record["settings"]["steps"], len(points))
                label = f"{name}, rate {entry['rate']:g}" if number == 0 else None
                axis.plot(steps, points[:, 2], color=COLOURS[name], label=label)
        axis.set(title=f"{error}, over the start", xlabel="step", yscale="log" if error == "features" else "linear")
        axis.legend(fontsize=8)
    return figure
