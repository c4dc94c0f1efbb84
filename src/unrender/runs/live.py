"""Observation and control of a run from outside, by files in its folder."""

from __future__ import annotations

import json
import os
import platform
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from pydantic import BaseModel

from unrender.backend.variant import current
from unrender.backend.versions import hardware, versions
from unrender.core import arrays, checks
from unrender.core.errors import InputError
from unrender.io import files
from unrender.io.resampling import reduced, resize_nearest
from unrender.runs.callbacks import Callback
from unrender.runs.folder import schema
from unrender.runs.folder.history import lines
from unrender.runs.folder.schema import COMMANDS, CONTROL, LIVE, LIVE_START, LIVE_STATUS, LIVE_VIEWS
from unrender.runs.metadata import recorded_measures

if TYPE_CHECKING:
    from unrender.runs.result import Result
    from unrender.runs.run import Run

_INTERVAL = 1.0
_RETRY_SECONDS = 5.0
_SHARE = 0.02
_POLL_SECONDS = 0.1
_VIEWS = 8
_PICTURE, _VOLUME = 512, 64
_LARGEST_OTHER = 1 << 16
_LARGEST_CONTROL = 4096


class Live(Callback):
    """Callback that writes the current state of a run about once per second, and executes commands.

    It writes to `live/` in the run folder: `status.json`; `views.npz`, with each view's image at which the loss was evaluated, and its
    control weight or pixel probability if any; `parameters.npz`; once, `run.json`, `start.npz` (references, and the first step's images),
    `initial.npz` and `truth.npz`; and `history.jsonl`, unless the run folder itself has one. Large images, textures and volumes are
    box-filtered; at most eight views are written. Each file is written atomically.

    `control.json` in the run folder contains {"command": "run"}, "pause" or "stop". A pause blocks after a step, and does not count as
    the run's time. A stop ends the run as Ctrl-C does. Commands from before the run are removed.

    The interval between updates grows with their cost, so that they take at most 2 % of the run's time.

    Args:
        folder: the run folder. If it is not writable, the run continues with a warning, still executes commands, and tries to write every
            few seconds. If the folder disappears, or `live` is a link, observation ends with a warning.
        name, method, command: as in `Result`, for display.
    """

    def __init__(self, folder: str | Path, name: str = "", method: str = "", command: str = ""):
        self._folder = checks.path("Live: folder", folder)
        self._name, self._method, self._command_line = name, method, command
        self._history = _LiveHistory(self._folder)
        self._disabled = False
        self._start: dict[str, np.ndarray] | None = None
        self._first_images_written = False
        self._warned: set[str] = set()
        self._next_poll = self._next_update = 0.0
        self._cost = 0.0
        self._initial_error: dict[str, float] = {}
        self._command: tuple[tuple[int, int, int], str] = ((0, 0, 0), "run")

    def on_start(self, run: Run) -> None:
        try:
            if self._live.is_symlink():
                raise InputError(f"{self._live}: a link, expected a folder")
            self.clear()
            self._start = run.full()
            self._live.mkdir(parents=True, exist_ok=True)
            self._write_start(run)
            self._write_status(run, "running", None)
        except (OSError, InputError) as error:
            self._put_off(run, error)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        if self._disabled:
            return
        self._history.append(record)
        now = time.monotonic()
        try:
            if now >= self._next_poll or run.stopped:
                self._next_poll = now + _POLL_SECONDS
                self._follow_command(run, record)
            if now >= self._next_update or run.stopped:
                self._update(run, record, "running")
        except (OSError, InputError) as error:
            self._put_off(run, error)

    def on_end(self, run: Run, result: Result) -> None:
        if self._disabled:
            return
        try:
            last = result.history[-1] if result.history else None
            self._write_status(run, "ended", last)
            (self._folder / CONTROL).unlink(missing_ok=True)
        except (OSError, InputError) as error:
            self._put_off(run, error)

    def clear(self) -> None:
        """Remove the files of this callback, once the run folder itself contains everything."""
        (self._folder / CONTROL).unlink(missing_ok=True)
        if not self._live.is_symlink():
            shutil.rmtree(self._live, ignore_errors=True)

    @property
    def _live(self) -> Path:
        return self._folder / LIVE

    def _follow_command(self, run: Run, record: dict[str, Any]) -> None:
        command = self._read_command()
        if command == "pause" and not run.stopped:
            try:
                self._update(run, record, "paused")
            except (OSError, InputError) as error:
                self._put_off(run, error)  # the run pauses although its status cannot be written
            # In a deleted folder no command could end the pause.
            while command == "pause" and not run.stopped and self._folder.is_dir():
                time.sleep(_POLL_SECONDS / 2)
                command = self._read_command()
            self._next_update = 0.0
        if command == "stop":
            run.stop("interrupted")

    def _read_command(self) -> str:
        """Return the current command; the last one if the file is invalid, "run" if there is none."""
        path = self._folder / CONTROL
        try:
            status = os.stat(path, follow_symlinks=False)
            # A writer that empties the file first may do both within the same tick of the clock.
            stamp = status.st_mtime_ns, status.st_ino, status.st_size
            if stamp != self._command[0]:
                self._command = stamp, self._command[1]
                if 0 < status.st_size <= _LARGEST_CONTROL and path.is_file() and not path.is_symlink():
                    content = json.loads(path.read_text("utf-8"))
                    command = content.get("command") if isinstance(content, dict) else None
                    if command in COMMANDS:
                        self._command = stamp, command
        except FileNotFoundError:
            self._command = (0, 0, 0), "run"
        except (OSError, ValueError, RecursionError):
            pass
        return self._command[1]

    def _update(self, run: Run, record: dict[str, Any], status: str) -> None:
        dr.sync_thread()  # pending computation counts as the run's time
        began = time.monotonic()
        if self._start is not None:
            if self._folder.is_dir():
                self._live.mkdir(exist_ok=True)
            self._write_start(run)
        if not self._first_images_written and run.estimate is not None:
            self._first_images_written = True
            views = {**_references(run), **{f"{name}/initial": image for name, image in _images(run).items()}}
            self._write_arrays(LIVE_START, views)
        self._write_arrays(LIVE_VIEWS, _views(run))
        self._write_arrays(schema.PARAMETERS, _reduced_parameters(run.full()))
        self._history.write(self._live)
        self._write_status(run, status, record)
        self._cost = time.monotonic() - began
        self._next_update = began + max(_INTERVAL, self._cost / _SHARE)

    def _write_start(self, run: Run) -> None:
        """Write the files that do not change during the run. Until then, `_start` holds the initial parameters."""
        initial = self._start or {}
        self._initial_error = run.problem.parameter_error(initial)
        self._write_arrays(LIVE_START, _references(run))
        self._write_arrays(schema.INITIAL, _reduced_parameters(initial))
        self._write_arrays(schema.PARAMETERS, _reduced_parameters(initial))
        if run.problem.truth:
            self._write_arrays(schema.TRUTH, _reduced_parameters(run.problem.truth))
        record = schema.RunRecord.model_construct(
            name=self._name or run.problem.name,
            method=self._method or type(run.estimator).__name__,
            settings={"estimator": repr(run.estimator), "optimizer": repr(run.optimizer)},
            seed=run.seed,
            command=self._command_line,
            versions=versions(),
            hardware=hardware(),
            variant=current() or "",
            problem={
                "parameters": list(initial),
                "views": len(run.problem.views),
                "loss": repr(run.problem.loss),
                "measures": recorded_measures(run.problem),
            },
        )
        _write_json(self._live / schema.RECORD, record)
        self._start = None

    def _write_arrays(self, name: str, values: Mapping[str, np.ndarray]) -> None:
        if not self._live.is_dir():  # writing would recreate a folder that a user removed
            raise InputError(f"{self._live}: the folder is gone")
        files.write_arrays(self._live / name, values, compress=False, durable=False)

    def _write_status(self, run: Run, status: str, record: Mapping[str, Any] | None) -> None:
        live_status = schema.LiveStatus.model_construct(
            status=status,
            stopped=run.stopped,
            step=run.step,
            steps=run.steps,
            seconds=run.clock,
            budget_seconds=run.seconds,
            loss=record["loss"] if record else None,
            samples=record["samples"] if record else 0,
            skipped=run.skipped,
            warnings=list(run.warnings),
            control=self._command[1],
            process=os.getpid(),
            host=platform.node(),
            initial_error=self._initial_error,
            shapes=run.problem.shapes(),
        )
        _write_json(self._live / LIVE_STATUS, live_status)

    def _put_off(self, run: Run, error: Exception) -> None:
        """Schedule another attempt after a failure; give up if the folder is gone or does not belong to this run."""
        reason = " ".join(str(error).split())
        to_be_made = self._start is not None and self._folder.is_dir()
        self._disabled = self._live.is_symlink() or not (self._live.is_dir() or to_be_made)
        self._next_update = time.monotonic() + _RETRY_SECONDS
        if self._disabled:
            line = f"the run continues, but can no longer be watched: {reason}"
        else:
            line = f"the run continues, but cannot be watched until there is room: {reason}"
        if (topic := f"{self._disabled} {reason[-40:]}") not in self._warned:
            self._warned.add(topic)
            run.warnings.append(line)


class _LiveHistory:
    """Appends to live/history.jsonl while the run folder itself has no history.jsonl."""

    def __init__(self, folder: Path):
        self._other = folder / schema.HISTORY
        self._records: list[Mapping[str, Any]] = []
        self._before = _stamp(self._other)

    def append(self, record: Mapping[str, Any]) -> None:
        self._records.append(record)

    def write(self, live: Path) -> None:
        path = live / schema.HISTORY
        if _stamp(self._other) != self._before:
            path.unlink(missing_ok=True)
        elif self._records:
            with path.open("ab", buffering=0) as file:
                size = file.tell()
                try:
                    data = lines(self._records)
                    while data:
                        data = data[file.write(data) :]
                except OSError:
                    file.truncate(size)
                    raise
        self._records.clear()


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def _references(run: Run) -> dict[str, np.ndarray]:
    views = run.problem.views[:_VIEWS]
    masks = {
        f"view{i}/mask": reduced(np.asarray(view.mask), _PICTURE)
        for i, view in enumerate(views)
        if view.mask is not None
    }
    return {f"view{i}/reference": reduced(np.asarray(view.reference), _PICTURE) for i, view in enumerate(views)} | masks


def _images(run: Run) -> dict[str, np.ndarray]:
    """Return {"view0": (H, W, 3)}, the images at which the loss was evaluated, of the views in the last estimate."""
    info = run.estimate.info if run.estimate is not None else {}
    images = {i: arrays.numpy(image) for i, image in info.get("images", {}).items() if i < _VIEWS}
    shapes = {i: (*size, 3) for i, size in enumerate(run.problem.sizes)}
    return {f"view{i}": reduced(image, _PICTURE) for i, image in images.items() if image.shape == shapes.get(i)}


def _views(run: Run) -> dict[str, np.ndarray]:
    views = {f"{name}/result": image for name, image in _images(run).items()}
    info = run.estimate.info if run.estimate is not None else {}
    for kind in ("control_weight", "pixel_probability"):
        for i, values in info.get(kind, {}).items():
            if i < _VIEWS and (array := arrays.numpy(values)).ndim in (2, 3):
                size = run.problem.sizes[i]
                small = reduced(np.empty((*size, 0), np.float32), _PICTURE).shape[:2]
                views[f"view{i}/{kind}"] = resize_nearest(reduced(array, _PICTURE), *small)
    return views


def _reduced_parameters(parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return textures and volumes box-filtered, and the minimum and maximum of other large arrays."""
    reduced_arrays = {}
    for key, value in parameters.items():
        array = np.asarray(value)
        if array.ndim == 4:
            array = reduced(array, _VOLUME, 3)
        elif array.ndim in (2, 3) and min(array.shape[:2]) > 1 and array.shape[2:] in ((), (1,), (3,), (4,)):
            array = reduced(array, _PICTURE)
        elif array.size > _LARGEST_OTHER:
            array = np.array([array.min(), array.max()])
        reduced_arrays[key] = array
    return reduced_arrays


def _write_json(path: Path, model: BaseModel) -> None:
    files.write(path, lines([schema.serialize(model)]), durable=False)
