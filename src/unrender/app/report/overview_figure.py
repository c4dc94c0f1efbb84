"""compare.png: pictures of the first view, the first recovered map, and the curves, for a README or a talk."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from unrender.app.report import panels, tone_mapping
from unrender.app.report.curves import Band
from unrender.app.report.equal_time import Comparison, Metric
from unrender.display import formatting, pictures, plots
from unrender.losses import metrics

_COLOURS = ("#2a6fdb", "#d9622b", "#1a9a6c", "#8a4fc4", "#b8860b", "#c2407f")
_COLUMNS = 6
_WIDTH = 10.0
_CURVES_HEIGHT = 3.4


def overview_figure(comparison: Comparison) -> bytes:
    """Return a PNG on a white background: a row of pictures, a row of maps (if there are any), a row of curves."""
    rows = [row[:_COLUMNS] for row in (_pictures(comparison), _maps(comparison)) if row]
    heights = [_WIDTH / len(row) * row[0][1].shape[0] / row[0][1].shape[1] + 0.3 for row in rows] + [_CURVES_HEIGHT]
    figure = Figure(figsize=(_WIDTH, sum(heights)), dpi=150, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    for i, row in enumerate(rows):
        columns = grid[i].subgridspec(1, len(row))
        for j, (title, picture) in enumerate(row):
            at = figure.add_subplot(columns[j])
            at.imshow(picture, interpolation="nearest" if max(picture.shape) < 400 else "auto", aspect="auto")
            at.set_title(_plain(title), fontsize=9)
            at.set_axis_off()
    below = grid[len(rows)].subgridspec(1, 2)
    left = figure.add_subplot(below[0])
    right = figure.add_subplot(below[1], sharey=left)
    metric = comparison.metrics[0]
    _draw(left, metric, "seconds")
    _draw(right, metric, "samples")
    right.tick_params(labelleft=False)
    left.set_title(_plain(metric.title), fontsize=9, loc="left")
    left.legend(frameon=False, fontsize=9)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _pictures(comparison: Comparison) -> list[tuple[str, np.ndarray]]:
    first = next(iter(comparison.representatives.values()))
    if not first.views:
        return []
    view, of = next(iter(first.views.items()))
    factor = metrics.exposure(of.reference)
    row = [("reference", of.reference)] + ([("start", of.initial)] if of.initial is not None else [])
    row += [(label, run.views[view].result) for label, run in comparison.representatives.items()]
    return [(title, tone_mapping.srgb(picture * factor)) for title, picture in row]


def _maps(comparison: Comparison) -> list[tuple[str, np.ndarray]]:
    first = next(iter(comparison.representatives.values()))
    key = next((key for key, truth in first.truth.items() if panels.is_map(truth)), None)
    if key is None:
        return []
    row = [(f"truth: {key}", first.truth[key]), ("start", first.initial[key])]
    row += [(label, run.parameters[key]) for label, run in comparison.representatives.items()]
    show = panels.ColourScale(first.truth[key])
    return [(title, show.colours(plane)) for title, array in row if (plane := pictures.plane(array)) is not None]


def _draw(axes: Axes, metric: Metric, axis: str) -> None:
    plotted = []
    for i, (name, outcome) in enumerate(metric.methods.items()):
        band: Band = getattr(outcome, f"over_{axis}")
        finite = np.where(np.isfinite(band.median), band.median, np.nan)
        high = np.where(np.isfinite(band.high), band.high, finite)
        colour = _COLOURS[i % len(_COLOURS)]
        axes.plot(band.x, finite, color=colour, label=_plain(name), linewidth=1.6)
        axes.fill_between(band.x, band.low, high, color=colour, alpha=0.18, linewidth=0)
        plotted.append(finite[np.isfinite(finite)])
    values = np.concatenate(plotted)
    if plots.is_logarithmic(values):
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: formatting.number(value)))
    label, format_value = plots.axis_format(axis)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: format_value(value)))
    axes.set_xlim(left=0.0)
    axes.set_xlabel(label, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(color="#edeae4")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _plain(text: str) -> str:
    """Return untrusted text in a form that matplotlib can draw.

    Mathematics is escaped. Characters without a glyph become "?". A leading underscore, which hides an entry of a legend, is removed.
    """
    printable = "".join(letter if letter.isprintable() and ord(letter) < 0x2000 else "?" for letter in text)
    short = printable if len(printable) <= 60 else printable[:57] + "…"
    return short.lstrip("_").replace("$", r"\$")
