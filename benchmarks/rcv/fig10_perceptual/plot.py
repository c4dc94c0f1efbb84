"""Figure."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.derivative_bias import METHODS
from benchmarks.runner.records import Record


def plot(record: Record) -> Figure:
    """The derivative of one run and its bias, each row in units of its own."""
    maps, found = record["maps"], record["bias"]["losses"]["perceptual"]
    figure, axes = plt.subplots(2, len(METHODS) + 1, figsize=(11, 5.6), layout="constrained")
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
    for row, given in zip(axes, pictures, strict=True):
        for axis, (title, picture) in zip(row, given, strict=True):
            axis.axis("off")
            if picture is None:
                continue
            top = float(np.quantile(np.abs(picture), 0.98))
            drawn = axis.imshow(picture, vmin=-top, vmax=top, cmap="RdBu_r")
            axis.set_title(title, fontsize=9)
            figure.colorbar(drawn, ax=axis, shrink=0.8)
    figure.suptitle("Derivative of the perceptual loss by each pixel, each picture with a scale of its own")
    return figure
