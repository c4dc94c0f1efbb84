"""The current state of a run folder: waiting, running, paused, finished, lost or vanished."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.io import bounded_files, files
from unrender.runs.folder import schema
from unrender.runs.folder.history import History, HistoryReader
from unrender.runs.folder.reader import RunFolder, ViewPictures, pictures_by_view, read, read_record
from unrender.runs.folder.schema import HISTORY, LIVE, LIVE_STATUS, RECORD, LiveStatus

_FILES = (
    RECORD,
    HISTORY,
    schema.PARAMETERS,
    schema.INITIAL,
    schema.TRUTH,
    schema.PICTURES,
    schema.SENSITIVITY,
    schema.MESHES,
)
_LIVE_FILES = (LIVE_STATUS, schema.LIVE_START, schema.LIVE_VIEWS, *_FILES)

WAITING, RUNNING, PAUSED, SAVING = "waiting", "running", "paused", "saving"
FINISHED, LOST, VANISHED = "finished", "lost", "vanished"
"""States of a run. A lost run is one whose process ended before the run did."""


@dataclass(frozen=True)
class Snapshot:
    """The known state of a run. `run` is None where no data could be read, and `problems` has a line for data that could not."""

    path: Path
    state: str
    run: RunFolder | None = None
    status: LiveStatus | None = None
    problems: tuple[str, ...] = ()

    @property
    def accepts_commands(self) -> bool:
        """True if the run reads commands."""
        return self.state in (RUNNING, PAUSED)


class RunMonitor:
    """A monitor of a run folder, with the number of changes so far. Its content is untrusted, and every file may be missing."""

    def __init__(self, path: Path):
        self.path = path
        self._last_stamps: tuple = ()
        self._last = Snapshot(path, WAITING)
        self._histories: dict[Path, HistoryReader] = {}
        self._existed = False
        self.revision = 0

    def snapshot(self) -> Snapshot:
        """Return the current state; the same object as before if no file has changed. It never raises because of the content of the
        folder."""
        stamps = self._stamps()
        if stamps != self._last_stamps:
            current = self._read()
            if current.run is None and self._last.run is not None and current.state in (VANISHED, WAITING):
                current = Snapshot(self.path, VANISHED, self._last.run, self._last.status, current.problems)
            self._last_stamps, self._last = stamps, current
            self.revision += 1
        return self._last

    def _stamps(self) -> tuple:
        """Return the change times, sizes and inodes of all files that are read, and whether the process of the run is alive."""
        stamps: list[Any] = []
        for path in [self.path / name for name in _FILES] + [self.path / LIVE / name for name in _LIVE_FILES]:
            try:
                status = os.stat(path, follow_symlinks=False)
                stamps.append((status.st_mtime_ns, status.st_size, status.st_ino))
            except OSError:
                stamps.append(None)
        status = self._last.status
        return (self.path.is_dir(), status is not None and _alive(status), *stamps)

    def _read(self) -> Snapshot:
        if not self.path.is_dir():
            return Snapshot(self.path, VANISHED if self._existed else WAITING)
        self._existed = True
        problems: list[str] = []
        status = self._try(problems, self._status)
        if status is not None and (status.status in (RUNNING, PAUSED) or not bounded_files.exists(self.path / RECORD)):
            run = self._try(problems, lambda: self._live(status, problems))
            state = SAVING if status.status not in (RUNNING, PAUSED) else status.status
            return Snapshot(self.path, state if _alive(status) else LOST, run, status, tuple(problems))
        if status is None and not bounded_files.exists(self.path / RECORD):
            return Snapshot(self.path, WAITING, problems=tuple(problems))
        run = self._try(problems, lambda: read(self.path))
        if run is None and status is not None:
            run = self._try(problems, lambda: self._live(status, problems))
        return Snapshot(self.path, FINISHED if run is not None else WAITING, run, status, tuple(problems))

    def _status(self) -> LiveStatus | None:
        path = self.path / LIVE / LIVE_STATUS
        if not bounded_files.exists(path):
            return None
        return schema.validate(LiveStatus, bounded_files.read_object(path, self.path), str(path))

    def _live(self, status: LiveStatus, problems: list[str]) -> RunFolder:
        """Return the data of a live run, from live/. Missing data is left out; unreadable data is left out and noted in `problems`."""
        live = self.path / LIVE
        record = read_record(live / RECORD, self.path)
        fields = {"stopped": status.stopped, "steps": status.step, "seconds": status.seconds}
        record = record.model_copy(update={**fields, "skipped": status.skipped, "warnings": status.warnings})
        parameters, initial, truth, start, views = (
            self._arrays(live / f"{name}.npz", problems)
            for name in ("parameters", "initial", "truth", "start", "views")
        )
        history = self._try(problems, self._history) or _EMPTY
        parameters = {key: value for key, value in parameters.items() if key in initial}
        return RunFolder(
            self.path,
            record,
            history,
            parameters,
            initial,
            {key: value for key, value in truth.items() if key in parameters},
            self._try(problems, lambda: _views(start, views, live)) or {},
            {key: error for key, error in status.initial_error.items() if key in parameters},
            {key: float(of.values[-1]) for key, of in history.parameter_error.items() if key in parameters},
            {key: tuple(shape) for key, shape in status.shapes.items()},
        )

    def _history(self) -> History | None:
        """Return the growing history: that in live/ if it exists, otherwise that of the folder."""
        for path in (self.path / LIVE / HISTORY, self.path / HISTORY):
            if bounded_files.exists(path):
                return self._histories.setdefault(path, HistoryReader(path, self.path)).read(to_the_end=False)
        return None

    def _arrays(self, path: Path, problems: list[str]) -> dict[str, np.ndarray]:
        if not bounded_files.exists(path):
            return {}
        return self._try(problems, lambda: bounded_files.read_float_arrays(path, self.path)) or {}

    def _try(self, problems: list[str], function: Callable[[], Any]) -> Any:
        """Return the result of `function`; None, and a line in `problems`, if the data is malformed or cannot be read."""
        try:
            return function()
        except InputError as error:
            problems.append(str(error))
        except FileNotFoundError:
            pass  # the file was replaced or removed during the read; the next snapshot sees the change
        except OSError as error:
            problems.append(f"{self.path}: cannot be read: {error.strerror or error}")
        return None


_EMPTY = History(*(np.array([]) for _ in range(4)), parameter_error={})


def _views(start: dict[str, np.ndarray], now: dict[str, np.ndarray], where: Path) -> dict[int, ViewPictures]:
    """Return the views that have a reference and a picture. A control weight of one channel is repeated over three channels."""
    arrays = {**start, **now}
    complete: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        view = name.partition("/")[0]
        if f"{view}/reference" not in arrays or f"{view}/result" not in arrays:
            continue
        if name.endswith("/control_weight") and (array.ndim == 2 or array.shape[-1] == 1):
            array = np.repeat(array.reshape(*array.shape[:2], 1), 3, axis=2)
        complete[name] = array
    return pictures_by_view(complete, where / "views.npz")


def _alive(status: LiveStatus) -> bool:
    """Return whether the process of the run is alive; True if this machine cannot tell."""
    return status.process is None or status.host != platform.node() or files.is_alive(status.process)
