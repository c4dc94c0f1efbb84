"""Convergence charts: one run with a line per parameter, or several runs in one chart."""

from __future__ import annotations

from collections.abc import Mapping

from unrender.app.report import curves
from unrender.app.report.curves import Series
from unrender.display import plots
from unrender.display.plots import Chart, Line
from unrender.rendering import parameter_errors
from unrender.runs.folder.reader import RunFolder

__all__ = ["charts", "charts_of_runs"]


def charts(run: RunFolder, axis: str) -> list[Chart]:
    """Parameter errors, loss, and gradient noise of one run, along "seconds" or "samples"."""
    history = run.history
    x = getattr(history, axis)
    end = float(x[-1]) if len(x) else 0.0
    loss, noise = curves.binned(x, history.loss), curves.binned(x, history.gradient_noise)
    errors = [(key, s) for key in run.known if (s := curves.parameter_error(run, key)) is not None]
    lines = [Line(key, getattr(s, axis), s.values, colour=i) for i, (key, s) in enumerate(errors)]
    found = [
        plots.chart(parameter_errors.title(run.measure(key) for key, _ in errors), lines, axis, end),
        plots.chart("Loss", [Line("loss", loss.x, loss.median, loss.low, loss.high)], axis, end),
        plots.chart("Gradient noise (share)", [Line("noise", noise.x, noise.median, noise.low, noise.high)], axis, end),
    ]
    return [chart for chart in found if chart is not None]


def charts_of_runs(runs: Mapping[str, RunFolder], colours: Mapping[str, int], axis: str) -> list[Chart]:
    """The same of several runs, one line each; of several parameters the mean error relative to the start."""
    ends = [float(getattr(run.history, axis)[-1]) for run in runs.values() if len(run.history)]
    if not ends:
        return []
    keys = [key for run in runs.values() for key in run.known]
    single = len(set(keys)) == 1
    measures = [run.measure(key) for run in runs.values() for key in run.known]
    title = parameter_errors.title(measures) if single else "Parameter error, relative to the start"
    errors = {label: _error(run, single) for label, run in runs.items()}
    lines = {
        title: [Line(k, getattr(s, axis), s.values, colour=colours[k]) for k, s in errors.items() if s is not None],
        "Loss": [_binned(label, run, "loss", axis, colours[label]) for label, run in runs.items()],
        "Gradient noise (share)": [
            _binned(label, run, "gradient_noise", axis, colours[label]) for label, run in runs.items()
        ],
    }
    found = [plots.chart(name, of, axis, max(ends)) for name, of in lines.items()]
    return [chart for chart in found if chart is not None]


def _error(run: RunFolder, single: bool) -> Series | None:
    if single and run.known:
        return curves.parameter_error(run, run.known[0])
    return curves.relative_error(run, run.known)


def _binned(label: str, run: RunFolder, column: str, axis: str, colour: int) -> Line:
    found = curves.binned(getattr(run.history, axis), getattr(run.history, column))
    return Line(label, found.x, found.median, colour=colour)
