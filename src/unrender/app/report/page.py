"""The page of one run."""

from __future__ import annotations

import webbrowser
from pathlib import Path

from unrender.app.report import html, image_metrics, panels, shapes, tables
from unrender.display import plots
from unrender.io.files import write
from unrender.runs.folder.reader import read

_VIEWS = 8
_MAPS = 24
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
    shown = dict(list(run.views.items())[:_VIEWS])
    maps = [key for key, value in run.parameters.items() if panels.is_map(value)]
    shown_shapes = [shapes.panel(run, key) for key in list(run.meshes)[:_SHAPES]]
    content = html.render(
        "page.html",
        run=run,
        stopped=tables.ending(run.record),
        command=run.record.command,
        facts=html.facts(run.record),
        tiles=tables.tiles(run),
        views=[panels.view_of_run(view, of) for view, of in shown.items()],
        more_views=len(run.views) - len(shown),
        view_rows=tables.view_rows(run),
        measures=image_metrics.available()[1:],
        shapes=shown_shapes,
        more_script="shapes.js" if shown_shapes else "",
        maps=[panels.map_of_run(run, key) for key in maps[:_MAPS]],
        more_maps=max(0, len(maps) - _MAPS),
        rows=[tables.parameter_row(run, key) for key in run.parameters],
        charts={axis: tables.charts(run, axis) for axis in plots.AXES},
    )
    path = write(run.path / "report.html", content)
    if open_after:
        webbrowser.open(path.resolve().as_uri())
    return path
