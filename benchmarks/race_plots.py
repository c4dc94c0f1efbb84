"""Curves of races."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np


def draw(axis: Any, entry: dict[str, Any], column: int, colour: Any, label: str, style: str = "-") -> None:
    """Median and range over seeds of the error, against seconds (column 0) or samples (1)."""
    end = min(run[-1][column] for run in entry["runs"])
    first = max(run[0][column] for run in entry["runs"])
    grid = np.linspace(first, end, 200)
    curves = np.stack([np.interp(grid, np.array(run)[:, column], np.array(run)[:, 2]) for run in entry["runs"]])
    axis.plot(grid, np.median(curves, 0), color=colour, label=label, ls=style)
    axis.fill_between(grid, curves.min(0), curves.max(0), color=colour, alpha=0.15, lw=0)


def colours(count: int) -> Any:
    """So many greys to oranges for a family of baselines."""
    return plt.get_cmap("YlOrBr")(np.linspace(0.3, 0.95, count))
