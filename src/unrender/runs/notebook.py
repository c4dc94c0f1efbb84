"""Display of a result as one line of text, and as HTML in a notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import periodic, phases
from unrender.display import formatting, notebook, pictures
from unrender.display.notebook import NotebookBar
from unrender.display.pictures import shown_image, shown_map
from unrender.display.plots import Line, chart
from unrender.rendering import parameter_errors
from unrender.rendering.parameter_errors import ErrorMeasure
from unrender.runs.callbacks import COMPILING, Callback

if TYPE_CHECKING:
    from unrender.runs.result import Result
    from unrender.runs.run import Run


_POINTS = 200

Curve = tuple[np.ndarray, np.ndarray]
"""Seconds, ascending, and values."""


def loss_curve(history: Sequence[Mapping[str, Any]]) -> Curve:
    """Return the loss from the steps' samples: means over up to 200 groups of consecutive steps; NaN for a group without finite values."""
    seconds = np.array([record["seconds"] for record in history], float)
    values = np.array([record["loss"] for record in history], float)
    values[~np.isfinite(values)] = np.nan
    groups = np.array_split(np.arange(len(history)), min(len(history), _POINTS)) if len(history) else []
    means = [np.mean(finite) if (finite := values[g][np.isfinite(values[g])]).size else np.nan for g in groups]
    return np.array([seconds[g[-1]] for g in groups]), np.array(means, float)


def error_curves(history: Sequence[Mapping[str, Any]], initial: Mapping[str, float]) -> dict[str, Curve]:
    """Return {key: error curve} of the measured errors, starting with `initial`."""
    curves: dict[str, Curve] = {}
    for key, first in initial.items():
        known = [
            (record["seconds"], record["parameter_error"][key])
            for record in history
            if key in record.get("parameter_error", {})
        ]
        if known:
            seconds, values = np.array([(0.0, first), *known], float).T
            curves[key] = seconds, values
    return curves


class NotebookProgress(Callback):
    """Progress bar in a notebook cell: compiling, steps with loss and parameter error, final images, and a final line. A context
    manager."""

    def __init__(self) -> None:
        self._bar = NotebookBar()
        self._listening = phases.listening(self._bar)
        self._summary = ""

    def __enter__(self) -> NotebookProgress:
        self._listening.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._listening.__exit__(None, None, None)
        self._bar.close(self._summary)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        parts = [
            f"step {run.step}" + (f" of {run.steps}" if run.steps else ""),
            f"loss {formatting.number(record['loss'])}",
        ]
        if errors := record.get("parameter_error"):
            parts.append("error " + ", ".join(map(formatting.number, errors.values())))
        self._bar.show(", ".join(parts), run.progress())

    def on_end(self, run: Run, result: Result) -> None:
        self._summary = f"{result.steps} steps in {formatting.duration(result.seconds)}"
        compiling = result.phases.get(COMPILING, 0.0)
        self._summary += f", without {formatting.duration(compiling)} of compiling" if compiling >= 0.5 else ""


_VIEWS, _MAPS = 2, 3


def line(result: Result) -> str:
    """Return a summary: Result('indirect-room', rcv: 300 steps in 12.3 s, parameter error 0.306 → 0.0283, finished)."""
    return f"Result({result.name!r}, {_summary(result)})"


def html(result: Result) -> str:
    """Return HTML with images, recovered textures with truth and start, curves, times and warnings."""
    end = result.seconds or 1.0
    seconds, loss = loss_curve(result.history)
    errors = error_curves(result.history, start_errors(result))
    lines = [Line(key, x, y, colour=index) for index, (key, (x, y)) in enumerate(errors.items())]
    measure_of = measures(result)
    title = parameter_errors.title(measure_of[key] for key in result.truth if key in measure_of)
    charts = [
        chart(title, lines, "seconds", end),
        chart("Loss, of the steps' samples", [Line("loss", seconds, loss)], "seconds", end) if len(loss) else None,
    ]
    rows = _numbers(result) | {"image error": _image_error(result), "time": formatting.phases(result.phases)}
    return notebook.block(
        f"Result of {result.name}, {_summary(result)}",
        notebook.picture_row(shown_pictures(result)),
        notebook.charts(charts),
        notebook.facts({name: text for name, text in rows.items() if text}),
        notebook.lines(result.warnings, "warning: "),
        notebook.lines(result.without_errors, ""),
    )


def shown_pictures(result: Result) -> dict[str, np.ndarray]:
    """Return {caption: (H, W, 3) in [0, 1]}: views, if there are images, then parameters that can be displayed as images."""
    shown: dict[str, np.ndarray] = {}
    measure_of = measures(result)
    for view in range(_VIEWS):
        reference = result.pictures.get(f"view{view}/reference")
        for what in ("reference", "initial", "result"):
            picture = result.pictures.get(f"view{view}/{what}")
            if picture is not None:
                shown[f"view {view}: {'start' if what == 'initial' else what}"] = shown_image(picture, reference)
    for key in [key for key, values in result.parameters.items() if pictures.is_map(values)][:_MAPS]:
        truth, columns = result.truth.get(key), measure_of[key].repeated
        like = result.parameters[key] if truth is None else truth
        for what, values in (("truth", truth), ("start", result.initial[key]), ("recovered", result.parameters[key])):
            colours = None if values is None else shown_map(periodic.interior(values, columns), like)
            if colours is not None:
                shown[f"{what}: {key}"] = colours
    return shown


def measures(result: Result) -> dict[str, ErrorMeasure]:
    recorded = result.problem.get("measures", {})
    return {key: parameter_errors.from_record(recorded.get(key)) for key in result.parameters}


def start_errors(result: Result) -> dict[str, float]:
    """Return {key: initial error} of parameters with a known truth, see `Problem.parameter_error`."""
    measure_of = measures(result)
    errors = {
        key: measure_of[key].error(result.initial[key], truth)
        for key, truth in result.truth.items()
        if key in result.initial
    }
    return {key: error for key, error in errors.items() if error is not None}


def _summary(result: Result) -> str:
    words = f"{result.method or 'run'}: {result.steps} steps in {formatting.duration(result.seconds)}"
    before = start_errors(result)
    last = next((record["parameter_error"] for record in reversed(result.history) if "parameter_error" in record), {})
    if before and last:
        units = {measure.unit for key, measure in measures(result).items() if key in last}
        if len(units) > 1:  # errors of different units have no mean
            return f"{words}, {result.status}"
        first, now = np.mean(list(before.values())), np.mean(list(last.values()))
        unit = "".join(units)
        words += f", parameter error {formatting.number(float(first))}{unit} → {formatting.number(float(now))}{unit}"
    return f"{words}, {result.status}"


def _numbers(result: Result) -> dict[str, str]:
    """{key: its values, with the standard errors of the run's noise, and the truth} of the parameters that are no maps."""
    rows = {}
    for key, recovered in result.parameters.items():
        if recovered.size > formatting.LISTED:
            continue
        error = result.standard_error.get(key)
        text = formatting.values(recovered, None if error is None else [float(each) for each in np.ravel(error)])
        truth = result.truth.get(key)
        rows[key] = text if truth is None else f"{text} (truth {formatting.values(np.asarray(truth))})"
    return rows


def _image_error(result: Result) -> str:
    parts = [
        formatting.with_error(*result.image_errors[name])
        for name in ("view0/initial", "view0/result")
        if name in result.image_errors
    ]
    return " → ".join(parts) + " (view 0, root mean square, noise removed)" if parts else ""
