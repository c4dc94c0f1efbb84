"""Charts of how runs came along: one run with its parameters apart, or several runs over one another."""

from __future__ import annotations

from collections.abc import Mapping

from unrender.report import curves, plots
from unrender.report.curves import Series
from unrender.report.plots import Chart, Line
from unrender.runs.folder.reader import RunFolder


def charts(run: RunFolder, over: str) -> list[Chart]:
    """Parameter errors, loss, and gradient noise of one run, over "seconds" or "samples"."""
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


def overlaid(runs: Mapping[str, RunFolder], colours: Mapping[str, int], over: str) -> list[Chart]:
    """The same of several runs, one line each; of several parameters the mean error relative to the start."""
    ends = [float(getattr(run.history, over)[-1]) for run in runs.values() if len(run.history)]
    if not ends:
        return []
    keys = [key for run in runs.values() for key in run.truth]
    alone = len(set(keys)) == 1
    title = "Parameter error (RMSE)" if alone else "Parameter error, relative to the start"
    errors = {label: _error(run, alone) for label, run in runs.items()}
    lines = {
        title: [Line(k, getattr(s, over), s.values, colour=colours[k]) for k, s in errors.items() if s is not None],
        "Loss": [_bucketed(label, run, "loss", over, colours[label]) for label, run in runs.items()],
        "Gradient noise (share)": [
            _bucketed(label, run, "gradient_noise", over, colours[label]) for label, run in runs.items()
        ],
    }
    found = [plots.chart(name, of, over, max(ends)) for name, of in lines.items()]
    return [chart for chart in found if chart is not None]


def _error(run: RunFolder, alone: bool) -> Series | None:
    if alone and run.truth:
        return curves.parameter_error(run, next(iter(run.truth)))
    return curves.relative_error(run, list(run.truth))


def _bucketed(label: str, run: RunFolder, what: str, over: str, colour: int) -> Line:
    found = curves.bucketed(getattr(run.history, over), getattr(run.history, what))
    return Line(label, found.x, found.median, colour=colour)
