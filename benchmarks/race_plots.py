"""Curves of races."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure


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


def over_time_and_paths(
    entries: Mapping[str, Any], seconds: str, styles: Callable[[dict[str, Any]], dict[str, tuple[Any, str]]]
) -> Figure:
    """Per problem: error over seconds, so named, and over paths. `styles`: {method: (colour, line style)} of a problem's methods."""
    figure, axes = plt.subplots(len(entries), 2, figsize=(12, 4.2 * len(entries)), squeeze=False, layout="constrained")
    for row, (name, entry) in zip(axes, entries.items(), strict=True):
        style = styles(entry["methods"])
        for column, (axis, unit) in enumerate(zip(row, (seconds, "paths"), strict=True)):
            for method, found in entry["methods"].items():
                label = f"{method}, rate {found['rate']:g}: {found['final'][0]:.3f}"
                draw(axis, found, column, style[method][0], label, style[method][1])
            axis.set(title=name, xlabel=unit, ylabel="parameter error / initial", yscale="log")
            if column:
                axis.set_xscale("log")
            else:
                axis.legend(fontsize=6)
    return figure
