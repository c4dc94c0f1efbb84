"""The text and the numbers on the page of a run: its head, its parameters, its views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from unrender.app.report import curves, tone_mapping
from unrender.display import formatting, plots
from unrender.display.plots import Chart, Line
from unrender.losses.metrics import rmse
from unrender.rendering import parameter_errors
from unrender.runs.callbacks import COMPILING
from unrender.runs.folder.reader import RunFolder
from unrender.runs.folder.schema import DOUBTFUL, RunRecord
from unrender.runs.image_sensitivity import seen_cells
from unrender.statistics import debiased


def charts(run: RunFolder, axis: str) -> list[Chart]:
    """Return the charts of one run along "seconds" or "samples": parameter errors, loss and gradient noise."""
    history = run.history
    x = getattr(history, axis)
    end = float(x[-1]) if len(x) else 0.0
    loss, noise = curves.binned(x, history.loss), curves.binned(x, history.gradient_noise)
    errors = [(key, s) for key in run.known if (s := curves.parameter_error(run, key)) is not None]
    lines = [Line(key, getattr(s, axis), s.values, colour=i) for i, (key, s) in enumerate(errors)]
    all_charts = [
        plots.chart(parameter_errors.title(run.measure(key) for key, _ in errors), lines, axis, end),
        plots.chart("Loss", [Line("loss", loss.x, loss.median, loss.low, loss.high)], axis, end),
        plots.chart("Gradient noise (share)", [Line("noise", noise.x, noise.median, noise.low, noise.high)], axis, end),
    ]
    return [chart for chart in all_charts if chart is not None]


def charts_of_runs(runs: Mapping[str, RunFolder], colours: Mapping[str, int], axis: str) -> list[Chart]:
    """Return charts with one line per run. The error of several parameters is the mean relative to the first run's start."""
    ends = [float(getattr(run.history, axis)[-1]) for run in runs.values() if len(run.history)]
    if not ends:
        return []
    keys = [key for run in runs.values() for key in run.known]
    start = next(iter(runs.values())).error_before
    single = len(set(keys)) == 1
    measures = [run.measure(key) for run in runs.values() for key in run.known]
    title = parameter_errors.title(measures) if single else "Mean parameter error, relative to the first run's start"
    errors = {
        label: curves.parameter_error(run, run.known[0])
        if single and run.known
        else curves.relative_error(run, run.known, start)
        for label, run in runs.items()
    }
    lines = {
        title: [Line(k, getattr(s, axis), s.values, colour=colours[k]) for k, s in errors.items() if s is not None],
        "Loss": [_binned(label, run, "loss", axis, colours[label]) for label, run in runs.items()],
        "Gradient noise (share)": [
            _binned(label, run, "gradient_noise", axis, colours[label]) for label, run in runs.items()
        ],
    }
    all_charts = [plots.chart(name, of, axis, max(ends)) for name, of in lines.items()]
    return [chart for chart in all_charts if chart is not None]


def _binned(label: str, run: RunFolder, column: str, axis: str, colour: int) -> Line:
    band = curves.binned(getattr(run.history, axis), getattr(run.history, column))
    return Line(label, band.x, band.median, colour=colour)


STOP_REASONS = {
    "steps": "all steps done",
    "seconds": "stopped when time was up",
    "interrupted": "interrupted: this is the state at the interruption",
    "terminated": "terminated: this is the state at the termination",
    "callback": "stopped by a callback",
    "non-finite": "failed: gradients were not finite, and the run was stopped; these are the last finite values",
}
"""Descriptions of the ends of a run, by `RunRecord.stopped`."""


def ending(record: RunRecord) -> str:
    """Describe how a run ended, with its status where the verification contradicts the end; return "" while the run continues."""
    reason = STOP_REASONS.get(record.stopped, record.stopped)
    return "; ".join(part for part in (record.status if record.status in DOUBTFUL else "", reason) if part)


@dataclass(frozen=True)
class Tile:
    """One number in the head of the page: its title, its value and a note."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class ParameterRow:
    """One line of the table of parameters. Values are text; errors are numbers, None where they are unknown.

    Attributes:
        recovered: recovered values, with the standard errors from the noise of the run if they are known.
        unit: unit of the errors; "" if it is the unit of the values.
        error_seen: final error over the cells that the pictures depend on.
        seen: fraction of these cells.
    """

    key: str
    shape: str
    truth: str
    start: str
    recovered: str
    swatch: str
    error_before: float | None
    error_after: float | None
    unit: str = ""
    error_seen: float | None = None
    seen: float | None = None


@dataclass(frozen=True)
class ViewRow:
    """One line of the table of views: errors (RMSE) at the start and of the result; its other measures, {} beyond the first views."""

    view: int
    before: float | None
    after: float | None
    measures: dict[str, float | None]


def tiles(run: RunFolder) -> list[Tile]:
    """Return the tiles in the head of the page of a run."""
    all_tiles = []
    known = {key: (run.error_before[key], after) for key, after in run.error_after.items() if key in run.error_before}
    ratios = [after / before for before, after in known.values() if 0 < before < math.inf]
    if len(known) == 1:
        ((key, errors),) = known.items()
        measure = run.measure(key)
        all_tiles.append(_tile("Parameter error", *errors, measure.name, measure.unit))
    elif ratios:
        all_tiles.append(Tile("Parameter error", f"{np.mean(ratios):.1%}", "of the start's, mean over parameters"))
    after = curves.image_error(run)
    if (measured := _image_error(run)) is not None:
        all_tiles.append(measured)
    elif after is not None:
        views = run.views.values()
        before = [rmse(of.initial, of.reference, of.mask) for of in views if of.initial is not None]
        start = float(np.mean(before)) if len(before) == len(views) else None
        all_tiles.append(_tile("Image error", start, after, "RMSE"))
    loss = curves.smoothed_loss(run, 0.05 * float(run.history.seconds[-1])) if len(run.history) else None
    if loss is not None:
        all_tiles.append(_tile("Loss", float(loss.values[0]), float(loss.values[-1]), "of the step's samples"))
    compiling = run.record.phases.get(COMPILING)
    note = f"of the steps, without {formatting.duration(float(f'{compiling:.2g}'))} of compiling" if compiling else ""
    all_tiles.append(Tile("Time", formatting.duration(run.record.seconds), note))
    skipped = f"{run.record.skipped} skipped, not finite" if run.record.skipped else ""
    all_tiles.append(Tile("Steps", f"{run.record.steps:,}".replace(",", "\u202f"), skipped))
    if len(run.history):
        samples, seconds = float(run.history.samples[-1]), float(run.history.seconds[-1])
        rate = f"{formatting.count(samples / seconds)} per second" if seconds > 0 else ""
        all_tiles.append(Tile("Samples", formatting.count(samples), rate))
    return all_tiles


def _image_error(run: RunFolder) -> Tile | None:
    """Return the debiased error of the last pictures, without their noise; None if it was not measured."""
    known = run.record.image_errors
    errors = {
        which: [known[name] for view in run.views if (name := f"view{view}/{which}") in known]
        for which in ("initial", "result")
    }
    if not run.views or any(len(measured) != len(run.views) for measured in errors.values()):
        return None
    before, after = (formatting.with_error(*debiased.mean(measured)) for measured in errors.values())
    return Tile("Image error", after, f"RMSE without the pictures' noise, from {before}")


def _tile(label: str, before: float | None, after: float, what: str, unit: str = "") -> Tile:
    note = f"{what}, from {formatting.number(before)}{unit}" if before is not None else what
    return Tile(label, f"{formatting.number(after)}{unit}", note)


def parameter_row(run: RunFolder, key: str) -> ParameterRow:
    """Return the line of one parameter."""
    measure, sensitivity = run.measure(key), run.sensitivity.get(key)
    result, initial, truth = run.parameters[key], run.initial[key], run.truth.get(key)
    return ParameterRow(
        key,
        " × ".join(str(n) for n in run.shape(key)) or "number",
        formatting.values(truth) if truth is not None else "",
        formatting.values(initial),
        formatting.values(result, run.record.standard_error.get(key)),
        _swatch(result),
        run.error_before.get(key),
        run.error_after.get(key),
        measure.unit,
        None if sensitivity is None or truth is None else measure.error(result, truth, seen_cells(sensitivity)),
        None if sensitivity is None or (where := seen_cells(sensitivity)) is None else float(where.mean()),
    )


def _swatch(array: np.ndarray) -> str:
    if array.size != 3 or not ((array >= 0) & (array <= 1)).all():
        return ""
    return "#" + "".join(f"{round(255 * float(value)):02x}" for value in tone_mapping.srgb(array.reshape(-1)))


def view_rows(run: RunFolder) -> list[ViewRow]:
    """Return the lines of all views."""
    measured = curves.measure_views(run)
    return [
        ViewRow(
            view,
            None if of.initial is None else rmse(of.initial, of.reference, of.mask),
            rmse(of.result, of.reference, of.mask),
            measured.get(view, {}),
        )
        for view, of in run.views.items()
    ]
