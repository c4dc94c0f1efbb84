"""Pages: report.html of one run; compare.html and compare.json of several runs at equal time."""

from __future__ import annotations

import base64
import json
import math
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unrender.app.report import curves, html, panels, tables
from unrender.app.report import groups as grouping
from unrender.app.report.equal_time import Comparison, compare_groups
from unrender.core.geometry import rotation
from unrender.display import formatting, plots
from unrender.display.pictures import data_uri
from unrender.display.plots import Chart, Line
from unrender.io.files import write
from unrender.runs.folder.reader import RunFolder, read
from unrender.scene.surfaces import area_normals

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
    shown_shapes = [shape_panel(run, key) for key in list(run.meshes)[:_SHAPES]]
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
        measures=curves.available()[1:],
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
        out: the folder of compare.html and compare.json; it is created if it is missing.

    Returns:
        The path of compare.html.

    Raises:
        InputError: no folders, a malformed folder, runs of different problems, or `out` cannot be written to.
    """
    return write_comparison(*load_comparison(directories), out)


def load_comparison(directories: Sequence[str | Path]) -> tuple[Comparison, list[str]]:
    """Return the numbers of a comparison and its weaknesses, one line each. Raises `InputError`, as in `compare`."""
    runs = [read(directory) for directory in directories]
    with np.errstate(over="ignore", invalid="ignore"):  # runs that diverged are compared, too
        notices = grouping.check_comparable(runs)
        count, measured = len(runs[0].views), len(curves.measured_views(runs[0]))
        if measured < count:
            notices.append(f"Metrics of the last pictures are means over the first {measured} of {count} views.")
        return compare_groups(grouping.group(runs)), notices


def write_comparison(comparison: Comparison, notices: list[str], out: str | Path) -> Path:
    """Write the page and its numbers; return the path of the page. Raises `InputError` if `out` cannot be written to."""
    folder = Path(out)
    write(folder / "compare.json", _numbers(comparison, notices))
    with np.errstate(over="ignore", invalid="ignore"):
        return write(folder / "compare.html", _page(comparison, notices))


def _page(comparison: Comparison, notices: list[str]) -> bytes:
    representatives = comparison.representatives
    first = next(iter(representatives.values()))
    truths = panels.maps_of(first, first.truth)
    found = {name: panels.maps_of(run, run.parameters) for name, run in representatives.items()}
    maps = list(truths)
    views = list(first.views)
    return html.render(
        "compare.html",
        comparison=comparison,
        notices=notices,
        first=comparison.groups[0].label,
        measures=curves.available(),
        name=first.record.name,
        facts=html.facts(first.record),
        commands={str(run.path): run.record.command for group in comparison.groups for run in group.runs},
        views=[
            panels.view_of_methods(v, {name: run.views[v] for name, run in representatives.items()})
            for v in views[:_COMPARED_VIEWS]
        ],
        more_views=max(0, len(views) - _COMPARED_VIEWS),
        maps=[
            panels.map_of_methods(k, {name: of[k] for name, of in found.items() if k in of}, truths[k])
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


MOST_FACES = 200_000
"""Limit of the faces of all meshes of a panel; larger meshes are not shown."""
_STEPS = (1 << 16) - 1
"""Number of quantisation steps of the positions along each side of the bounding cube of all meshes."""
_SIZE = 280  # width and height of each mesh in the picture, in pixels
_TURN, _TILT = 0.6, 0.35  # angles of the picture and of the first view, in radians: about the vertical, and downwards


@dataclass(frozen=True)
class Solid:
    """A mesh in the encoding of the page.

    Attributes:
        label: name of the mesh: "Start", "Recovered" or "Truth".
        positions: base64 of uint16 (V, 3), little-endian: 0 to 65535 along each side of the bounding cube that all meshes share.
        faces: base64 of uint32 (F, 3).
    """

    label: str
    positions: str
    faces: str


@dataclass(frozen=True)
class ShapePanel:
    """Meshes from left to right that rotate together, none if they are too large or not finite; and a PNG of them, as a data URI."""

    title: str
    note: str
    solids: tuple[Solid, ...]
    picture: str = ""
    width: int = 0
    height: int = 0


def shape_panel(run: RunFolder, key: str) -> ShapePanel:
    """Return the panel of a mesh whose vertex positions are a parameter: start, result and, where it is known, truth."""
    mesh = run.meshes[key]
    shown = {"Start": (run.initial[key], mesh.first_faces), "Recovered": (run.parameters[key], mesh.faces)}
    if mesh.truth is not None:
        shown["Truth"] = (mesh.truth.vertices, mesh.truth.faces)
    solids = {label: (np.asarray(x, np.float64).reshape(-1, 3), faces) for label, (x, faces) in shown.items()}
    count = f"{len(run.parameters[key]) // 3} vertices, {len(mesh.faces)} faces"
    if sum(len(faces) for _, faces in solids.values()) > MOST_FACES:
        return ShapePanel(key, f"{count}: too large to be shown here; see meshes/", ())
    if not all(np.isfinite(vertices).all() for vertices, _ in solids.values()):
        return ShapePanel(key, f"{count}; not finite", ())
    before, after = run.error_before.get(key), run.error_after.get(key)
    if before is not None and after is not None:
        count += (
            f"; distance from the truth {formatting.number(after)}, from {formatting.number(before)} (root mean square)"
        )
    every = np.concatenate([vertices for vertices, _ in solids.values()])
    low, high = every.min(axis=0), every.max(axis=0)
    middle, half = (low + high) / 2, max(float((high - low).max()) / 2, 1e-12)
    placed = {label: ((vertices - middle) / half, faces) for label, (vertices, faces) in solids.items()}
    packed = tuple(
        Solid(label, _packed((vertices + 1) / 2 * _STEPS + 0.5, "<u2"), _packed(faces, "<u4"))
        for label, (vertices, faces) in placed.items()
    )
    return ShapePanel(key, count, packed, _picture(list(placed.values())), _SIZE * len(placed), _SIZE)


def _packed(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode("ascii")


def _picture(solids: list[tuple[np.ndarray, np.ndarray]]) -> str:
    from PIL import Image, ImageDraw

    image = Image.new("RGBA", (_SIZE * len(solids), _SIZE))
    draw = ImageDraw.Draw(image)
    turn = rotation((1, 0, 0), _TILT) @ rotation((0, 1, 0), -_TURN)
    for number, (vertices, faces) in enumerate(solids):
        rotated = vertices @ turn.T
        normals = area_normals(rotated, faces)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        shade = 0.25 + 0.65 * np.abs(normals @ np.array([0.36, 0.48, 0.8]))
        at = _SIZE * (0.5 + rotated[:, :2] * [0.29, -0.29]) + [_SIZE * number, 0]
        for face in np.argsort(rotated[faces][:, :, 2].sum(axis=1)):  # painter's algorithm: the farthest face first
            grey = int(255 * shade[face])
            draw.polygon([tuple(p) for p in at[faces[face]].tolist()], fill=(grey, grey, grey, 255))
    return data_uri(image)
