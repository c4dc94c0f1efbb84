"""Pages: report.html of one run; compare.html, compare.png and compare.json of several runs at equal time."""

from __future__ import annotations

import json
import math
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unrender.app.report import curves, html, image_metrics, panels, shapes, tables
from unrender.app.report import groups as grouping
from unrender.app.report.equal_time import Comparison, compare_groups
from unrender.display import formatting, plots
from unrender.display.plots import Chart, Line
from unrender.io.files import write
from unrender.runs.folder.reader import RunFolder, read

_RUN_VIEWS = 8
_RUN_MAPS = 24
_SHAPES = 6


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
    shown = dict(list(run.views.items())[:_RUN_VIEWS])
    maps = [key for key, value in run.parameters.items() if panels.is_map(value)]
    shown_shapes = [shapes.panel(run, key) for key in list(run.meshes)[:_SHAPES]]
    content = html.render(
        "page.html",
        run=run,
        stopped=tables.ending(run.record),
        command=run.record.command,
        facts=html.facts(run.record),
        tiles=tables.tiles(run),
        values=formatting.few_values(run.parameters, run.record.standard_error),
        views=[panels.view_of_run(view, of) for view, of in shown.items()],
        more_views=len(run.views) - len(shown),
        view_rows=tables.view_rows(run),
        measures=image_metrics.available()[1:],
        shapes=shown_shapes,
        more_script="shapes.js" if shown_shapes else "",
        maps=[panels.map_of_run(run, key) for key in maps[:_RUN_MAPS]],
        more_maps=max(0, len(maps) - _RUN_MAPS),
        rows=[tables.parameter_row(run, key) for key in run.parameters],
        charts={axis: tables.charts(run, axis) for axis in plots.AXES},
    )
    path = write(run.path / "report.html", content)
    if open_after:
        webbrowser.open(path.resolve().as_uri())
    return path


_COMPARED_VIEWS = 4
_COMPARED_MAPS = 8


def compare(directories: Sequence[str | Path], out: str | Path) -> Path:
    """Compare runs of one problem, grouped by method over seeds. Ratios are relative to the method of the first run.

    Args:
        directories: run folders.
        out: the folder of compare.html, compare.png and compare.json; it is created if it is missing.

    Returns:
        The path of compare.html.

    Raises:
        InputError: no folders, a malformed folder, runs of different problems, or `out` cannot be written to.
    """
    return write_comparison(*load_comparison(directories), out)


def load_comparison(directories: Sequence[str | Path]) -> tuple[Comparison, list[str]]:
    """Return the numbers of a comparison and its weaknesses, one line each.

    Raises:
        InputError: as in `compare`.
    """
    runs = [read(directory) for directory in directories]
    with np.errstate(over="ignore", invalid="ignore"):  # runs that diverged are compared, too
        notices = grouping.check_comparable(runs)
        count, measured = len(runs[0].views), len(image_metrics.measured_views(runs[0]))
        if measured < count:
            notices.append(f"Metrics of the last pictures are means over the first {measured} of {count} views.")
        return compare_groups(grouping.group(runs)), notices


def write_comparison(comparison: Comparison, notices: list[str], out: str | Path) -> Path:
    """Write the page, its picture and its numbers; return the path of the page.

    Raises:
        InputError: `out` cannot be written to.
    """
    from unrender.app.report.overview_figure import overview_figure  # matplotlib takes a second to import

    folder = Path(out)
    write(folder / "compare.json", _numbers(comparison, notices))
    with np.errstate(over="ignore", invalid="ignore"):
        write(folder / "compare.png", overview_figure(comparison))
        return write(folder / "compare.html", _page(comparison, notices))


def _page(comparison: Comparison, notices: list[str]) -> bytes:
    representatives = comparison.representatives
    first = next(iter(representatives.values()))
    maps = [key for key, truth in first.truth.items() if panels.is_map(truth)]
    views = list(first.views)
    return html.render(
        "compare.html",
        comparison=comparison,
        notices=notices,
        first=comparison.groups[0].label,
        measures=image_metrics.available(),
        name=first.record.name,
        facts=html.facts(first.record),
        commands={str(run.path): run.record.command for group in comparison.groups for run in group.runs},
        views=[
            panels.view_of_methods(v, {name: run.views[v] for name, run in representatives.items()})
            for v in views[:_COMPARED_VIEWS]
        ],
        more_views=max(0, len(views) - _COMPARED_VIEWS),
        maps=[
            panels.map_of_methods(k, {name: run.parameters[k] for name, run in representatives.items()}, first.truth[k])
            for k in maps[:_COMPARED_MAPS]
        ],
        more_maps=max(0, len(maps) - _COMPARED_MAPS),
        charts={axis: _charts(comparison, axis) for axis in plots.AXES},
    )


def _charts(comparison: Comparison, axis: str) -> list[Chart]:
    charts = []
    for metric in comparison.metrics:
        lines = []
        for colour, (name, outcome) in enumerate(metric.methods.items()):
            band = getattr(outcome, f"over_{axis}")
            several = outcome.reached.runs > 1
            low, high = (band.low, band.high) if several else (None, None)
            lines.append(Line(name, band.x, band.median, low, high, colour))
        charts.append(plots.chart(metric.title, lines, axis, max(float(line.x[-1]) for line in lines)))
    return [chart for chart in charts if chart is not None]


def _numbers(comparison: Comparison, notices: list[str]) -> bytes:
    """Return the content of compare.json. Values that are unknown or not finite are null."""
    numbers = {
        "problem": comparison.groups[0].runs[0].record.name,
        "first": comparison.groups[0].label,
        "seconds": comparison.seconds,
        "samples": comparison.samples,
        "notices": notices,
        "methods": [
            {
                "label": group.label,
                "method": group.runs[0].record.method,
                "settings": group.runs[0].record.settings,
                "runs": [_run(run) for run in group.runs],
                "image_error": comparison.image_error[group.label],
                "images": {name: of[group.label] for name, of in comparison.images.items()},
            }
            for group in comparison.groups
        ],
        "metrics": [
            {
                "name": metric.name,
                "title": metric.title,
                "best_of_first": metric.best_of_first,
                "first_improves": metric.improves,
                "methods": metric.methods,
            }
            for metric in comparison.metrics
        ],
    }
    return (json.dumps(_plain(numbers), indent=1, allow_nan=False) + "\n").encode()


def _run(run: RunFolder) -> dict[str, Any]:
    return {
        "directory": str(run.path),
        "seed": run.record.seed,
        "stopped": run.record.stopped,
        "steps": run.record.steps,
        "seconds": float(run.history.seconds[-1]),
        "samples": float(run.history.samples[-1]),
        "skipped": run.record.skipped,
        "image_error": curves.image_error(run),
    }


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(part) for part in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
