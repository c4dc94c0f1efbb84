"""The figure of a loss landscape."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from benchmarks.loss_landscape import LOSSES, SPP


def plot_landscape(axes: Any, found: dict[str, Any], of: str) -> None:
    """Two rows (losses) of loss and derivative, against a factor `of` something."""
    factors = np.array(found["factors"])
    colours = dict(zip(map(str, SPP), ("#c0392b", "#d1782a", "#4a9c6d", "#1f6fb4"), strict=True))
    for row, name in zip(axes, LOSSES, strict=True):
        for spp, colour in colours.items():
            rows = np.array(found["table"][name][spp])
            place = found["places"][name][spp]
            for axis, column, where in ((row[0], 0, place["least"]), (row[1], 2, place["stop"])):
                axis.errorbar(factors, rows[:, column], rows[:, column + 1], color=colour, label=f"{spp} spp", lw=1.4)
                if where is not None:
                    y = 0.0 if column else np.interp(where, factors, rows[:, column])
                    axis.plot([where], [y], "x", color=colour, ms=9, mew=2.5, zorder=5)
        row[1].axhline(0.0, color="black", lw=0.7)
        for axis in row:
            axis.axvline(1.0, color="black", lw=0.7, ls=":")
            axis.set_xlabel(f"factor on {of} (truth 1)")
        row[0].set(title=f"{name}: mean loss (× least)", ylabel="loss", yscale="log")
        row[1].set(title=f"{name}: mean derivative (× where a descent stops)", ylabel="d loss / d factor")
        row[0].margins(y=0.2)
        row[0].legend(fontsize=8, ncols=4, loc="upper left")
        missing = [spp for spp in colours if found["places"][name][spp]["stop"] is None]
        if missing:
            handle = Line2D([], [], color="none", label=f"no stop in this range: {', '.join(missing)} spp")
            row[1].legend(handles=[handle], fontsize=8, loc="upper left", handlelength=0)
