"""What the live page shows, from snapshots of runs: the same panels, tables and charts as a report has."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader

from unrender.report import convergence, html, panels, plots, tables, words
from unrender.report.images import Drawing, Painter
from unrender.runs.folder.reader import RunFolder
from unrender.watch import source
from unrender.watch.source import Snapshot

_COLOURS = 6
_MAPS = 8
_KEPT = 8
_STATES = {
    source.WAITING: "waiting for the run to begin",
    source.RUNNING: "running",
    source.PAUSED: "paused",
    source.SAVING: "done, saving",
    source.FINISHED: "finished",
    source.LOST: "ended without a word",
    source.VANISHED: "the folder is gone",
}


@dataclass(frozen=True)
class RunRow:
    """One run among those that are watched; all of it text.

    Attributes:
        number: its place, from 0.
        label, state, word: what it is called, what it does, and that in words.
        step, seconds, samples, loss, error: how far it is.
        listens, paused: whether its buttons do something, and which of them are there.
    """

    number: int
    label: str
    state: str
    word: str
    step: str
    seconds: str
    samples: str
    loss: str
    error: str
    listens: bool
    paused: bool
    path: str

    @property
    def colour(self) -> int:
        """Of its curves."""
        return self.number % _COLOURS


class Gallery:
    """The pictures that a page may ask for, by names that this class gives. Those of the last few pages are kept."""

    def __init__(self) -> None:
        self._drawings: dict[str, tuple[int, Drawing]] = {}
        self.pages = 0

    def turn(self) -> None:
        """Begin a page: forget what only older ones have than the last few."""
        self.pages += 1
        self._drawings = {name: of for name, of in self._drawings.items() if self.keeps(of[0])}

    def keeps(self, page: int) -> bool:
        """Whether the pictures of a page, numbered as `pages` was, can still be had."""
        return page > self.pages - _KEPT

    def place(self, drawing: Drawing) -> str:
        """Keep a drawing; returns where it is served, the same place for the same drawing."""
        values = np.ascontiguousarray(drawing.values)
        told = (
            values.shape,
            zlib.crc32(values.data),
            drawing.factor,
            drawing.low,
            drawing.high,
            drawing.map,
            drawing.root,
        )
        name = hashlib.blake2b(repr(told).encode(), digest_size=12).hexdigest()
        self._drawings[name] = self.pages, drawing
        return f"picture/{name}"

    def find(self, name: str) -> Drawing | None:
        """The drawing of this name, while it is kept."""
        return self._drawings[name][1] if name in self._drawings else None


def render(template: str, snapshots: Sequence[Snapshot], gallery: Gallery, chosen: int = 0, view: int = 0) -> str:
    """The page or the part of it that changes, as HTML with everything that comes from the runs escaped.

    Args:
        template: "watch.html", or "watch_main.html" for the part.
        snapshots: the runs, at least one.
        gallery: where the pictures go.
        chosen, view: the run and the view whose pictures are shown; the first ones where there are no such.
    """
    gallery.turn()
    labels = _labels([snapshot.path for snapshot in snapshots])
    chosen = chosen if 0 <= chosen < len(snapshots) else 0
    run = snapshots[chosen].run
    with np.errstate(all="ignore"):  # pictures of a run that diverges overflow, and are shown all the same
        context: dict[str, Any] = {
            "rows": [_row(i, labels[i], snapshot) for i, snapshot in enumerate(snapshots)],
            "name": next((s.run.record.name for s in snapshots if s.run is not None), labels[0]),
            "chosen": chosen,
            "labels": labels,
            "charts": _charts(snapshots, labels),
            "notices": _notices(snapshots, labels),
            **_of_run(snapshots[chosen], run, gallery, view),
        }
        return environment().get_template(template).render(context)


def _of_run(snapshot: Snapshot, run: RunFolder | None, gallery: Gallery, view: int) -> dict[str, Any]:
    if run is None:
        return {
            "run": None,
            "panel": None,
            "views": [],
            "view": 0,
            "parameters": [],
            "maps": [],
            "more_maps": 0,
            "facts": {},
        }
    paint = Painter(gallery.place)
    now = "Result" if snapshot.state == source.FINISHED else "Current"
    view = view if view in run.views else next(iter(run.views), 0)
    maps = [key for key, value in run.parameters.items() if panels.is_map(value)]
    return {
        "run": run,
        "panel": panels.view_of_run(view, run.views[view], paint, now) if run.views else None,
        "views": list(run.views),
        "view": view,
        "parameters": [tables.row(run, key) for key in run.parameters],
        "maps": [
            panels.map_of_run(k, run.parameters[k], run.initial[k], run.truth.get(k), paint) for k in maps[:_MAPS]
        ],
        "more_maps": max(0, len(maps) - _MAPS),
        "command": run.record.command,
        "facts": html.facts(run.record),
    }


def _row(number: int, label: str, snapshot: Snapshot) -> RunRow:
    run, status = snapshot.run, snapshot.status
    step = seconds = samples = loss = error = ""
    if run is not None:
        live = None if snapshot.state == source.FINISHED else status
        of = f" / {live.steps}" if live is not None and live.steps else ""
        budget = f" of {words.duration(live.budget_seconds)}" if live is not None and live.budget_seconds else ""
        step, seconds = f"{run.record.steps}{of}", words.duration(run.record.seconds) + budget
        known = run.history.loss[np.isfinite(run.history.loss)]
        loss = words.number(float(np.median(known[-9:]))) if known.size else ""
        samples = words.count(float(run.history.samples[-1])) if len(run.history) else ""
        error = ", ".join(words.number(value) for value in list(run.error_after.values())[:3])
    paused = snapshot.state == source.PAUSED
    word = _STATES[snapshot.state]
    if run is not None and run.record.stopped and snapshot.state in (source.FINISHED, source.SAVING):
        word += f": {tables.STOPPED.get(run.record.stopped, run.record.stopped)}"
    return RunRow(
        number, label, snapshot.state, word, step, seconds, samples, loss, error, snapshot.listens, paused,
        str(snapshot.path),
    )  # fmt: skip


def _charts(snapshots: Sequence[Snapshot], labels: Sequence[str]) -> dict[str, list[plots.Chart]]:
    runs = {label: s.run for label, s in zip(labels, snapshots, strict=True) if s.run is not None}
    if len(snapshots) == 1 and runs:
        found = {over: convergence.charts(next(iter(runs.values())), over) for over in plots.AXES}
    else:
        colours = {label: i % _COLOURS for i, label in enumerate(labels)}
        found = {over: convergence.overlaid(runs, colours, over) for over in plots.AXES}
    return found


def _notices(snapshots: Sequence[Snapshot], labels: Sequence[str]) -> list[str]:
    found = []
    for label, snapshot in zip(labels, snapshots, strict=True):
        who = f"{label}: " if len(labels) > 1 else ""
        told = [*snapshot.problems, *(snapshot.run.record.warnings if snapshot.run is not None else ())]
        found += [who + line for line in told]
    return found


def _labels(paths: Sequence[Path]) -> list[str]:
    """The folders' names; their whole paths where names repeat."""
    names = [path.resolve().name or str(path) for path in paths]
    return [str(path) if names.count(name) > 1 else name for name, path in zip(names, paths, strict=True)]


@cache
def environment() -> Environment:
    """The report's templates and those of the live page."""
    return html.environment(PackageLoader("unrender.watch", "templates"))
