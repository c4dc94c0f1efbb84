"""The content of the live page, from snapshots of runs, with the panels, tables and charts of a report."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader

from unrender.app.report import html, panels, tables
from unrender.app.report.tone_mapping import PictureData, PictureEncoder
from unrender.app.watch import monitor
from unrender.app.watch.monitor import Snapshot
from unrender.display import formatting, plots
from unrender.runs.folder.reader import RunFolder

_MAPS = 8
_CACHED_PAGES = 8
_STATES = {
    monitor.WAITING: "waiting for the run to begin",
    monitor.RUNNING: "running",
    monitor.PAUSED: "paused",
    monitor.SAVING: "done, saving",
    monitor.FINISHED: "finished",
    monitor.LOST: "ended unexpectedly",
    monitor.VANISHED: "the folder is gone",
}


@dataclass(frozen=True)
class RunRow:
    """The row of a watched run: its label, its state (see `monitor`) and that in words, its progress, and the buttons that it has."""

    number: int
    label: str
    state: str
    state_text: str
    step: str
    seconds: str
    samples: str
    loss: str
    error: str
    accepts_commands: bool
    paused: bool
    path: str

    @property
    def colour(self) -> int:
        """The index of the colour of its curves."""
        return self.number % len(plots.COLOURS)


class PictureCache:
    """A cache of the pictures of the last few pages, by names that it assigns."""

    def __init__(self) -> None:
        self._entries: dict[str, tuple[int, PictureData]] = {}
        self.pages = 0

    def start_page(self) -> None:
        """Start a page: remove the pictures that none of the last few pages shows."""
        self.pages += 1
        self._entries = {name: of for name, of in self._entries.items() if self.has_page(of[0])}

    def has_page(self, page: int) -> bool:
        """Return whether the pictures of the page with number `page` (the value of `pages` at that time) are still cached."""
        return page > self.pages - _CACHED_PAGES

    def add(self, picture: PictureData) -> str:
        """Cache a picture and return its address. Equal pictures have the same address."""
        values = np.ascontiguousarray(picture.values)
        fields = (
            values.shape,
            zlib.crc32(values.data),
            picture.factor,
            picture.low,
            picture.high,
            picture.map,
            picture.root,
        )
        name = hashlib.blake2b(repr(fields).encode(), digest_size=12).hexdigest()
        self._entries[name] = self.pages, picture
        return f"picture/{name}"

    def get(self, name: str) -> PictureData | None:
        """Return the picture of this name; None if it is not cached."""
        return self._entries[name][1] if name in self._entries else None


def render(template: str, snapshots: Sequence[Snapshot], pictures: PictureCache, chosen: int = 0, view: int = 0) -> str:
    """Render the page, or "watch_main.html", its part that changes. All text that comes from the runs is escaped.

    `chosen` and `view` are indices of the run and of the view whose pictures are shown; the first one for an index out of range.
    """
    pictures.start_page()
    paths = [snapshot.path for snapshot in snapshots]
    names = [path.resolve().name or str(path) for path in paths]
    labels = [str(path) if names.count(name) > 1 else name for name, path in zip(names, paths, strict=True)]
    chosen = chosen if 0 <= chosen < len(snapshots) else 0
    run = snapshots[chosen].run
    with np.errstate(all="ignore"):  # pictures of a diverging run overflow, but are shown nevertheless
        context: dict[str, Any] = {
            "rows": [_row(i, labels[i], snapshot) for i, snapshot in enumerate(snapshots)],
            "name": next((s.run.record.name for s in snapshots if s.run is not None), labels[0]),
            "chosen": chosen,
            "labels": labels,
            "charts": _charts(snapshots, labels),
            "notices": _notices(snapshots, labels),
            **_of_run(snapshots[chosen], run, pictures, view),
        }
        return environment().get_template(template).render(context)


def _of_run(snapshot: Snapshot, run: RunFolder | None, pictures: PictureCache, view: int) -> dict[str, Any]:
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
    encoder = PictureEncoder(pictures.add)
    now = "Result" if snapshot.state == monitor.FINISHED else "Current"
    view = view if view in run.views else next(iter(run.views), 0)
    maps = [key for key, value in run.parameters.items() if panels.is_map(value)]
    return {
        "run": run,
        "panel": panels.view_of_run(view, run.views[view], encoder, now) if run.views else None,
        "views": list(run.views),
        "view": view,
        "parameters": [tables.parameter_row(run, key) for key in run.parameters],
        "maps": [panels.map_of_run(run, key, encoder) for key in maps[:_MAPS]],
        "more_maps": max(0, len(maps) - _MAPS),
        "command": run.record.command,
        "facts": html.facts(run.record),
    }


def _row(number: int, label: str, snapshot: Snapshot) -> RunRow:
    run, status = snapshot.run, snapshot.status
    step = seconds = samples = loss = error = ""
    if run is not None:
        live = None if snapshot.state == monitor.FINISHED else status
        of = f" / {live.steps}" if live is not None and live.steps else ""
        budget = f" of {formatting.duration(live.budget_seconds)}" if live is not None and live.budget_seconds else ""
        step, seconds = f"{run.record.steps}{of}", formatting.duration(run.record.seconds) + budget
        known = run.history.loss[np.isfinite(run.history.loss)]
        loss = formatting.number(float(np.median(known[-9:]))) if known.size else ""
        samples = formatting.count(float(run.history.samples[-1])) if len(run.history) else ""
        error = ", ".join(formatting.number(value) for value in list(run.error_after.values())[:3])
    paused = snapshot.state == monitor.PAUSED
    state_text = _STATES[snapshot.state]
    if run is not None and snapshot.state in (monitor.FINISHED, monitor.SAVING):
        reason = tables.ending(run.record)
        if snapshot.state == monitor.FINISHED and run.record.status in ("interrupted", "failed"):
            state_text = reason or run.record.status
        elif reason:
            state_text += f": {reason}"
    return RunRow(
        number, label, snapshot.state, state_text, step, seconds, samples, loss, error, snapshot.accepts_commands, paused,
        str(snapshot.path),
    )  # fmt: skip


def _charts(snapshots: Sequence[Snapshot], labels: Sequence[str]) -> dict[str, list[plots.Chart]]:
    runs = {label: s.run for label, s in zip(labels, snapshots, strict=True) if s.run is not None}
    if len(snapshots) == 1 and runs:
        charts = {axis: tables.charts(next(iter(runs.values())), axis) for axis in plots.AXES}
    else:
        colours = {label: i % len(plots.COLOURS) for i, label in enumerate(labels)}
        charts = {axis: tables.charts_of_runs(runs, colours, axis) for axis in plots.AXES}
    return charts


def _notices(snapshots: Sequence[Snapshot], labels: Sequence[str]) -> list[str]:
    lines = []
    for label, snapshot in zip(labels, snapshots, strict=True):
        who = f"{label}: " if len(labels) > 1 else ""
        fields = [*snapshot.problems, *(snapshot.run.record.warnings if snapshot.run is not None else ())]
        lines += [who + line for line in fields]
    return lines


@cache
def environment() -> Environment:
    """Return a Jinja environment with the templates of the report and of the live page."""
    return html.environment(_loader())


def source(name: str) -> str:
    """Return the text of a style sheet or script among the templates."""
    return _loader().get_source(environment(), name)[0]


@cache
def _loader() -> ChoiceLoader:
    return ChoiceLoader([PackageLoader("unrender.app.watch", "templates"), html.loader()])
