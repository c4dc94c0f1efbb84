"""Figures of two kinds: curves in panels, and pictures in rows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import ticker
from matplotlib.figure import Figure

from unrender.losses.metrics import srgb

ERROR = "error / at the start"
_NARROW = 5.0
"""Ratio of the limits of a logarithmic axis below which its ticks are evenly spaced."""
Values = Sequence[float] | np.ndarray
Curves = Sequence[Sequence[Any]]
"""A curve of each run, (x values, y values)."""


def curves(
    panels: Mapping[str, Mapping[str, Curves]],
    x: str,
    y: str = ERROR,
    columns: int = 4,
    log: str = "y",
    level: float | None = None,
    panel: tuple[float, float] = (4.2, 3.4),
) -> Figure:
    """Draw the median and the range over runs of each contender, a panel for each title.

    Args:
        panels: curves by title and contender.
        x: label of the horizontal axes.
        y: label of the vertical axes.
        columns: panels side by side.
        log: the axes with a logarithmic scale, "", "x", "y" or "xy".
        level: y of a thin line across each panel.
        panel: width and height of a panel in inches.
    """
    panels = {title: contenders for title, contenders in panels.items() if contenders}
    columns = min(columns, len(panels))
    rows = math.ceil(len(panels) / columns)
    size = (panel[0] * columns, panel[1] * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for axis in axes.flat[len(panels) :]:
        axis.set_axis_off()
    labels: set[str] = set()
    for axis, (title, contenders) in zip(axes.flat, panels.items(), strict=False):
        for label, runs in contenders.items():
            grid = _grid(runs, "x" in log)
            values = np.stack([np.interp(grid, *run) for run in runs])
            (line,) = axis.plot(grid, np.median(values, axis=0), label=label)
            axis.fill_between(grid, values.min(axis=0), values.max(axis=0), color=line.get_color(), alpha=0.15, lw=0)
        if level is not None:
            axis.axhline(level, color="black", lw=0.7)
        axis.set(title=title)
        if "x" in log:
            axis.set_xscale("log")
        if "y" in log:
            axis.set_yscale("log")
            low, high = axis.get_ylim()
            narrow = high < _NARROW * low
            axis.yaxis.set_major_locator(
                ticker.MaxNLocator(4) if narrow else ticker.LogLocator(subs=(1, 2, 5), numticks=6)
            )
            axis.yaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
            axis.yaxis.set_minor_locator(ticker.NullLocator())
        if contenders.keys() - labels:
            axis.legend(fontsize=7)
        labels |= contenders.keys()
    for axis in axes[:, 0]:
        axis.set_ylabel(y)
    for index, axis in enumerate(axes.flat[: len(panels)]):
        if index + columns >= len(panels):
            axis.set_xlabel(x)
    return figure


def pictures(rows: Sequence[Mapping[str, np.ndarray]], signed: bool = False, **options: Any) -> Figure:
    """Draw rows of pictures below their titles: linear colours (H, W, 3), or maps (H, W).

    Args:
        rows: pictures by title.
        signed: whether the colours of maps are symmetric around zero.
        options: of `imshow` for maps.
    """
    columns = max(map(len, rows))
    size = (2.6 * columns, 2.8 * len(rows))
    figure, axes = plt.subplots(len(rows), columns, figsize=size, squeeze=False, layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for line, row in zip(axes, rows, strict=True):
        for axis, (title, picture) in zip(line, row.items(), strict=False):
            axis.set_title(title, fontsize=9)
            if picture.ndim == 3:
                axis.imshow(srgb(picture))
            else:
                top = float(np.quantile(np.abs(picture), 0.98))
                scale = {"cmap": "RdBu_r", "vmin": -top, "vmax": top} if signed else options
                figure.colorbar(axis.imshow(picture, **scale), ax=axis, shrink=0.8)
    return figure


def points(runs: Sequence[Any], column: int = 0) -> Curves:
    """Return curves of runs of (seconds, samples, error): the error over the seconds (column 0) or samples (1)."""
    return [(run[:, column], run[:, 2]) for run in map(np.array, runs)]


def error_panels(entries: Mapping[str, Any], seconds: str = "seconds") -> dict[str, dict[str, Curves]]:
    """Return panels for `curves`: each entry's errors over seconds and over paths, a curve for each method and its rate."""
    return {
        f"{name}, over {unit}": {
            f"{method}, rate {found['rate']:g}": points(found["runs"], column)
            for method, found in entry["methods"].items()
        }
        for name, entry in entries.items()
        for column, unit in enumerate((seconds, "paths"))
    }


def race_curves(methods: Mapping[str, Any], error: str, column: int = 0) -> dict[str, Curves]:
    """Return an error of each method of a race over the seconds (column 0) or samples (1), its final median in the label."""
    return {
        f"{name}: {found['final'][error][0]:.3f}": points(found["runs"][error], column)
        for name, found in methods.items()
    }


def run_curves(methods: Mapping[str, Any]) -> dict[str, Curves]:
    """Return the curves of each method's runs, whose "curve" is (x values, y values)."""
    return {name: [run["curve"] for run in found["runs"]] for name, found in methods.items() if "runs" in found}


def from_start(runs: Iterable[Sequence[tuple[float, float]]], start: float = 1.0) -> Curves:
    """Return curves of runs of (seconds, error), each from the start's error at 0 seconds on."""
    return [tuple(zip((0.0, start), *run, strict=True)) for run in runs]


def over_steps(*runs: Values) -> Curves:
    """Return curves of values at steps 0, 1, ..."""
    return [(range(len(run)), run) for run in runs]


def band(x: Values, mean: Values, error: Values) -> Curves:
    """Return curves whose median is the mean, and whose range is a standard error to both sides."""
    middle, spread = np.array(mean), np.array(error)
    return [(x, middle - spread), (x, middle), (x, middle + spread)]


def _grid(runs: Curves, log: bool) -> np.ndarray:
    """Where the curves are interpolated: their own points if all have the same, else evenly over what all cover."""
    if all(np.array_equal(run[0], runs[0][0]) for run in runs):
        return np.asarray(runs[0][0], float)
    first, last = max(run[0][0] for run in runs), min(run[0][-1] for run in runs)
    return np.geomspace(max(first, last / 1e4), last, 200) if log else np.linspace(first, last, 200)
