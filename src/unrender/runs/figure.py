"""A result as a matplotlib figure."""

from __future__ import annotations

import io
import math
import textwrap
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from unrender.display import plots
from unrender.runs import notebook

if TYPE_CHECKING:
    from unrender.runs.result import Result


_WIDTH, _CURVES_HEIGHT, _COLUMNS = 9.0, 2.8, 6
_LONGEST_TITLE = 22


class ResultFigure(Figure):
    """A figure that a notebook displays with or without pyplot. It belongs to no pyplot session, so it is displayed only once."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue()


def plot(result: Result) -> ResultFigure:
    """Return the figure of `Result.plot`."""
    shown = list(notebook.shown_pictures(result).items())
    rows = math.ceil(len(shown) / _COLUMNS)
    columns = min(max(len(shown), 1), _COLUMNS)
    picture_height = _WIDTH / max(columns, 3) * 1.08
    figure = ResultFigure(figsize=(_WIDTH, rows * picture_height + _CURVES_HEIGHT), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    heights = [picture_height] * rows + [_CURVES_HEIGHT]
    grid = figure.add_gridspec(rows + 1, 1, height_ratios=heights)
    for row in range(rows):
        cells = grid[row].subgridspec(1, columns)
        for column, (caption, colours) in enumerate(shown[row * _COLUMNS : (row + 1) * _COLUMNS]):
            axes = figure.add_subplot(cells[column])
            axes.imshow(colours, interpolation="nearest" if max(colours.shape) < 200 else "auto")
            axes.set_title(_title(caption), fontsize=8)
            axes.set_axis_off()
    below = grid[rows].subgridspec(1, 2)
    errors = notebook.error_curves(result.history, notebook.start_errors(result))
    _draw(figure.add_subplot(below[0]), notebook.error_title(result).lower().replace("rmse", "RMSE"), errors)
    _draw(figure.add_subplot(below[1]), "loss, of the steps' samples", {"loss": notebook.loss_curve(result.history)})
    return figure


def _draw(axes: Axes, title: str, curves: dict[str, notebook.Curve]) -> None:
    axes.set_title(title, fontsize=9, loc="left")
    axes.set_xlabel("seconds", fontsize=9)
    axes.tick_params(which="both", labelsize=8)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    for key, (seconds, values) in curves.items():
        axes.plot(seconds, values, label=_title(key), linewidth=1.6)
    finite = [values[np.isfinite(values)] for _, values in curves.values()]
    if finite and plots.is_logarithmic(np.concatenate(finite)):
        axes.set_yscale("log")
    if len(curves) > 1:
        axes.legend(frameon=False, fontsize=8)
    if not curves:
        axes.text(0.5, 0.5, "the truth is not known", transform=axes.transAxes, ha="center", fontsize=9, alpha=0.6)


def _title(text: str) -> str:
    """Escape matplotlib's mathematics, and break long titles into lines."""
    plain = text.replace("$", r"\$").lstrip("_")
    what, colon, key = plain.partition(": ")
    if not colon or len(plain) <= _LONGEST_TITLE:
        return plain
    return "\n".join([what, *textwrap.wrap(key.replace(".", ". "), _LONGEST_TITLE)]).replace(". ", ".")
