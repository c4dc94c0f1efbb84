"""Display of a set of runs: a live table on a terminal, otherwise a line for each completed run."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.live import Live
from rich.text import Text

from unrender.core.errors import InputError
from unrender.core.text import visible
from unrender.display import formatting
from unrender.display.terminal import Console, Group, Renderable, columns
from unrender.io import bounded_files
from unrender.runs.folder import schema
from unrender.runs.folder.schema import LIVE, LIVE_STATUS, LiveStatus

_PER_SECOND = 2.0
_MOST_ROWS = 20


@dataclass(frozen=True)
class _Task:
    """A running task: its label, start time, and possible run folders."""

    label: str
    since: float
    folders: tuple[Path, ...]


class TaskDisplay:
    """Shows the running tasks. Use as a context manager.

    Args:
        console: output console.
        what: name of the tasks, such as "trials".
        below: renderable below the table of running tasks; None for nothing.
    """

    def __init__(self, console: Console, total: int, what: str, below: Callable[[], Renderable] | None = None):
        self._console, self._total, self._what, self._below = console, total, what, below
        self._running: dict[object, _Task] = {}
        self._ended = 0
        self._began = time.monotonic()
        self._lock = threading.Lock()
        self._live: Live | None = None

    def __enter__(self) -> TaskDisplay:
        if self._console.is_terminal:
            self._live = Live(
                get_renderable=self._render, console=self._console, refresh_per_second=_PER_SECOND, transient=True
            )
            self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.__exit__(None, None, None)
            self._live = None

    def begin(self, key: object, label: str, folders: tuple[Path, ...]) -> None:
        """Record the start of a task, which uses these run folders in turn."""
        with self._lock:
            self._running[key] = _Task(label, time.monotonic(), folders)

    def end(self, key: object, line: str) -> None:
        """Record the end of a task, with its summary line."""
        with self._lock:
            self._running.pop(key, None)
            self._ended += 1
        if self._live is None:
            self.say(f"{self._ended}/{self._total} {line}")

    def skip(self, count: int) -> None:
        """Record tasks that had ended before."""
        self._ended += count

    def say(self, line: str) -> None:
        """Print a permanent line."""
        self._console.say(visible(line))
        self._console.file.flush()

    def _render(self) -> Renderable:
        with self._lock:
            rows, ended = list(self._running.values()), self._ended
        elapsed = formatting.duration(time.monotonic() - self._began)
        head = Text(f"{ended} of {self._total} {self._what} ended, {len(rows)} running, {elapsed}")
        table = columns("running", "seed", "step", "loss", "since")
        for row in rows[:_MOST_ROWS]:
            folder, status = _status(row.folders)
            since = formatting.duration(time.monotonic() - row.since)
            if status is None:
                table.add_row(Text(visible(row.label)), "", "starting", "", since)
                continue
            step = f"{status.step}/{status.steps}" if status.steps else str(status.step)
            loss = "" if status.loss is None else f"{status.loss:.4g}"
            seed = folder.name.rpartition("-seed")[2]
            table.add_row(Text(visible(row.label)), seed, step, loss, since)
        parts: list[Renderable] = [head, table]
        if self._below is not None:
            parts.append(self._below())
        return Group(*parts)


def _status(folders: tuple[Path, ...]) -> tuple[Path, LiveStatus | None]:
    """Return the folder of the current run and its live status; the first folder and None if no status is visible."""
    for folder in folders:
        path = folder / LIVE / LIVE_STATUS
        with contextlib.suppress(InputError, OSError):
            if path.is_file():
                return folder, schema.validate(LiveStatus, bounded_files.read_object(path, folder), str(path))
    return folders[0], None
