"""Figure."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.derivative_bias import METHODS
from benchmarks.internals import srgb
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """The derivative of one run and its bias, each row in units of its own; then the walls where descents end."""
    maps, found = record["maps"], record["bias"]["losses"]["perceptual"]
    figure, axes = plt.subplots(3, len(METHODS) + 1, figsize=(11, 8.4), layout="constrained")
    exact = maps["perceptual/reference"]
    pictures: list[list[tuple[str, Any]]] = [
        [("converged", exact), *((f"{method}, one run", maps[f"perceptual/{method}"]) for method in METHODS)],
        [
            ("", None),
            *(
                (f"{method}: bias, rms {found[method]['rms']:.2f}", maps[f"perceptual/{method}/bias"])
                for method in METHODS
            ),
        ],
    ]
    for row, given in zip(axes[:2], pictures, strict=True):
        for axis, (title, picture) in zip(row, given, strict=True):
            axis.axis("off")
            if picture is None:
                continue
            top = float(np.quantile(np.abs(picture), 0.98))
            drawn = axis.imshow(picture, vmin=-top, vmax=top, cmap="RdBu_r")
            axis.set_title(title, fontsize=9)
            figure.colorbar(drawn, ax=axis, shrink=0.8)
    ends = {name: entry["final"][0] for name, entry in record["tasks"]["cornell-box"]["methods"].items()}
    titles = {
        "reference": "wall: reference",
        **{name: f"wall: {name} spp, error {end:.2f}" for name, end in ends.items()},
    }
    for axis, (name, title) in zip(axes[2], titles.items(), strict=True):
        axis.axis("off")
        axis.imshow(srgb(maps[f"wall/{name}"]), interpolation="nearest")
        axis.set_title(title, fontsize=9)
    figure.suptitle(
        "Derivative of the perceptual loss by each pixel, each picture with a scale of its own; walls that descents on it find"
    )
    return figure
