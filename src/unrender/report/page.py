"""The page of one run."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.files import write
from unrender.report import curves, html, panels, pictures, plots, words
from unrender.report.folder import RunFolder, read
from unrender.report.plots import Chart, Line

_VIEWS = 8
_MAPS = 24
_LISTED_VALUES = 4
_STOPPED = {
    "steps": "all steps done",
    "seconds": "stopped when time was up",
    "interrupted": "interrupted: this is what was reached",
    "callback": "stopped by a callback",
    "non-finite": "given up: gradients were not finite",
}


@dataclass(frozen=True)
class Tile:
    """One figure of the page's head: what it was, what it became."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class ParameterRow:
    """One line of the table of parameters. Values as text, errors as numbers, None where not known."""

    key: str
    shape: str
    truth: str
    start: str
    recovered: str
    swatch: str
    error_before: float | None
    error_after: float | None


@dataclass(frozen=True)
class ViewRow:
    """One line of the table of views: root mean square errors over pixels and channels."""

    view: int
    before: float | None
    after: float | None


def page(directory: str | Path, open_after: bool = False) -> Path:
    """Write report.html into a run folder: one file, no network needed.

    Args:
        directory: the run folder.
        open_after: show it in the web browser.

    Returns:
        The path of the page.

    Raises:
        InputError: the folder is not a run folder, or a file or field of it is malformed, or it cannot be written to.
    """
    run = read(directory)
    shown = dict(list(run.views.items())[:_VIEWS])
    maps = [key for key, value in run.parameters.items() if panels.is_map(value)]
    content = html.render(
        "page.html",
        run=run,
        stopped=_STOPPED.get(run.record.stopped, run.record.stopped),
        command=html.command(run.record),
        facts=html.facts(run.record),
        tiles=_tiles(run),
        views=[panels.view_of_run(view, of) for view, of in shown.items()],
        more_views=len(run.views) - len(shown),
        view_rows=_view_rows(run),
        maps=[panels.map_of_run(k, run.parameters[k], run.initial[k], run.truth.get(k)) for k in maps[:_MAPS]],
        more_maps=max(0, len(maps) - _MAPS),
        rows=[_row(run, key) for key in run.parameters],
        charts={over: _charts(run, over) for over in ("seconds", "samples")},
    )
    path = write(run.path / "report.html", content)
    if open_after:
        webbrowser.open(path.resolve().as_uri())
    return path


def _tiles(run: RunFolder) -> list[Tile]:
    found = []
    series = [(key, s) for key in run.truth if (s := curves.parameter_error(run, key)) is not None]
    if len(series) == 1:
        found.append(_tile("Parameter error", float(series[0][1].values[0]), float(series[0][1].values[-1]), "RMSE"))
    elif (relative := curves.relative_error(run, list(run.truth))) is not None:
        found.append(Tile("Parameter error", f"{relative.values[-1]:.1%}", "of the start's, mean over parameters"))
    after = curves.image_error(run)
    if after is not None:
        rows = _view_rows(run)
        before = [row.before for row in rows if row.before is not None]
        start = float(np.mean(before)) if len(before) == len(rows) else None
        found.append(_tile("Image error", start, after, "RMSE"))
    loss = curves.smoothed_loss(run, 0.05 * float(run.history.seconds[-1])) if len(run.history) else None
    if loss is not None:
        found.append(_tile("Loss", float(loss.values[0]), float(loss.values[-1]), "of the step's samples"))
    note = f"and {words.duration(run.record.warmup_seconds)} of warm-up" if run.record.warmup_seconds else ""
    found.append(Tile("Time", words.duration(run.record.seconds), note))
    skipped = f"{run.record.skipped} skipped, not finite" if run.record.skipped else ""
    found.append(Tile("Steps", f"{run.record.steps:,}".replace(",", "\u202f"), skipped))
    if len(run.history):
        samples, seconds = float(run.history.samples[-1]), float(run.history.seconds[-1])
        rate = f"{words.count(samples / seconds)} per second" if seconds > 0 else ""
        found.append(Tile("Samples", words.count(samples), rate))
    return found


def _tile(label: str, before: float | None, after: float, unit: str) -> Tile:
    return Tile(label, words.number(after), f"{unit}, from {words.number(before)}" if before is not None else unit)


def _row(run: RunFolder, key: str) -> ParameterRow:
    result, initial, truth = run.parameters[key], run.initial[key], run.truth.get(key)
    return ParameterRow(
        key,
        " × ".join(str(n) for n in result.shape) or "number",
        _values(truth) if truth is not None else "",
        _values(initial),
        _values(result),
        _swatch(result),
        None if truth is None else pictures.root_mean_square(initial, truth),
        None if truth is None else pictures.root_mean_square(result, truth),
    )


def _values(array: np.ndarray) -> str:
    if array.size == 0:
        return ""
    if array.size > _LISTED_VALUES:
        return " … ".join(words.number(float(value)) for value in (array.min(), array.max()))
    return ", ".join(words.number(float(value)) for value in array.reshape(-1))


def _swatch(array: np.ndarray) -> str:
    """The colour of a parameter of three values within [0, 1], as #rrggbb; empty for others."""
    if array.size != 3 or not ((array >= 0) & (array <= 1)).all():
        return ""
    return "#" + "".join(f"{round(255 * float(value)):02x}" for value in pictures.srgb(array.reshape(-1)))


def _view_rows(run: RunFolder) -> list[ViewRow]:
    return [
        ViewRow(
            view,
            None if of.initial is None else pictures.root_mean_square(of.initial, of.reference),
            pictures.root_mean_square(of.result, of.reference),
        )
        for view, of in run.views.items()
    ]


def _charts(run: RunFolder, over: str) -> list[Chart]:
    history = run.history
    x = getattr(history, over)
    end = float(x[-1]) if len(x) else 0.0
    loss, noise = curves.bucketed(x, history.loss), curves.bucketed(x, history.gradient_noise)
    errors = [(key, s) for key in run.truth if (s := curves.parameter_error(run, key)) is not None]
    lines = [Line(key, getattr(s, over), s.values, colour=i) for i, (key, s) in enumerate(errors)]
    found = [
        plots.chart("Parameter error (RMSE)", lines, over, end),
        plots.chart("Loss", [Line("loss", loss.x, loss.median, loss.low, loss.high)], over, end),
        plots.chart("Gradient noise (share)", [Line("noise", noise.x, noise.median, noise.low, noise.high)], over, end),
    ]
    return [chart for chart in found if chart is not None]
