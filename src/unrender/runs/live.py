"""A run that can be looked at, paused and stopped from outside, by files in its folder."""

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

from unrender.core import arrays
from unrender.io import files
from unrender.core.errors import InputError
from unrender.io.thumbnails import reduced, resize_nearest
from unrender.runs.callbacks import Callback
from unrender.runs.folder.history import lines
from unrender.runs.result import hardware, versions
from unrender.backend.variant import current

if TYPE_CHECKING:
    from unrender.runs.loop import Run
    from unrender.runs.result import Result

FOLDER = "live"
"""Within the run folder."""
CONTROL = "control.json"
"""In the run folder: {"command": "run" | "pause" | "stop"}."""
COMMANDS = ("run", "pause", "stop")

_INTERVAL = 1.0
_SHARE = 0.02
_LOOK = 0.1
_VIEWS = 8
_PICTURE, _VOLUME = 512, 64
_WHOLE = 1 << 16
_LONGEST_CONTROL = 4096


class Live(Callback):
    """Writes what a run looks like now, about once a second, and obeys commands.

    Into `live/` of the run folder go: `status.json`; `views.npz`, each view's picture as the loss saw it, with its control weight or
    pixel probability where there is one; `parameters.npz`; once, `run.json`, `start.npz` (references, and the first step's pictures),
    `initial.npz` and `truth.npz`; and `history.jsonl`, unless somebody writes one in the run folder itself. Large pictures,
    textures and volumes are box-filtered, of the first eight views at most. Each file is written beside its place and renamed.

    `control.json` in the run folder holds {"command": "run"}, "pause" or "stop". A pause blocks after a step, and is no time of the
    run; a stop ends the run as Ctrl-C does. Commands left from before the run are removed.

    The time between two updates grows with what they cost, so that they take at most 2 % of the run's.

    Args:
        folder: the run folder. Where it cannot be written to, or vanishes, the run goes on with a warning.
        name, method, command, settings: as `Result` has them, for people.
    """

    def __init__(
        self,
        folder: str | Path,
        name: str = "",
        method: str = "",
        command: str = "",
        settings: Mapping[str, Any] | None = None,
    ):
        self._folder = Path(folder)
        self._told = {"name": name, "method": method, "command": command, "settings": dict(settings or {})}
        self._history = _OwnHistory(self._folder)
        self._silent = False
        self._started = False
        self._next_look = self._next_update = 0.0
        self._cost = 0.0
        self._initial_error: dict[str, float] = {}
        self._command: tuple[tuple[int, int], str] = ((0, 0), "run")

    def on_start(self, run: Run) -> None:
        """See `Callback.on_start`."""
        try:
            if self._live.is_symlink():
                raise InputError(f"{self._live}: a link, expected a folder")
            self.clear()
            self._live.mkdir(parents=True, exist_ok=True)
            self._write_start(run)
            self._write_status(run, "running", None)
        except (OSError, InputError) as error:
            self._give_up(run, error)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        """See `Callback.on_step`."""
        if self._silent:
            return
        self._history.take(record)
        now = time.monotonic()
        try:
            if now >= self._next_look or run.stopped:
                self._next_look = now + _LOOK
                self._obey(run, record)
            if now >= self._next_update or run.stopped:
                self._update(run, record, "running")
        except (OSError, InputError) as error:
            self._give_up(run, error)

    def on_end(self, run: Run, result: Result) -> None:
        """See `Callback.on_end`."""
        if self._silent:
            return
        try:
            last = result.history[-1] if result.history else None
            self._write_status(run, "ended", last)
            (self._folder / CONTROL).unlink(missing_ok=True)
        except (OSError, InputError) as error:
            self._give_up(run, error)

    def clear(self) -> None:
        """Remove what this callback wrote, once the run folder itself tells all of it."""
        (self._folder / CONTROL).unlink(missing_ok=True)
        if not self._live.is_symlink():
            shutil.rmtree(self._live, ignore_errors=True)

    @property
    def _live(self) -> Path:
        return self._folder / FOLDER

    def _obey(self, run: Run, record: dict[str, Any]) -> None:
        command = self._read_command()
        if command == "pause" and not run.stopped:
            self._update(run, record, "paused")
            # Nobody could say "run" in a folder that is gone.
            while command == "pause" and not run.stopped and self._live.is_dir():
                time.sleep(_LOOK / 2)
                command = self._read_command()
            self._next_update = 0.0
        if command == "stop":
            run.stop("interrupted")

    def _read_command(self) -> str:
        """The command that holds now; the last one where the file is no command, "run" where there is none."""
        path = self._folder / CONTROL
        try:
            status = os.stat(path, follow_symlinks=False)
            stamp = status.st_mtime_ns, status.st_ino
            if stamp != self._command[0]:
                self._command = stamp, self._command[1]
                if 0 < status.st_size <= _LONGEST_CONTROL and path.is_file() and not path.is_symlink():
                    found = json.loads(path.read_text("utf-8"))
                    command = found.get("command") if isinstance(found, dict) else None
                    if command in COMMANDS:
                        self._command = stamp, command
        except FileNotFoundError:
            self._command = (0, 0), "run"
        except (OSError, ValueError, RecursionError):
            pass
        return self._command[1]

    def _update(self, run: Run, record: dict[str, Any], status: str) -> None:
        dr.sync_thread()  # what is still being computed is the run's own time
        began = time.monotonic()
        if not self._live.is_dir():  # writing would bring back a folder that somebody removed
            raise InputError(f"{self._live}: the folder is gone")
        if not self._started and run.estimate is not None:
            self._started = True
            views = {**_references(run), **{f"{name}/initial": image for name, image in _images(run).items()}}
            files.write_arrays(self._live / "start.npz", views, compress=False)
        files.write_arrays(self._live / "views.npz", _views(run), compress=False)
        files.write_arrays(self._live / "parameters.npz", _small(run.full()), compress=False)
        self._history.write(self._live)
        self._write_status(run, status, record)
        self._cost = time.monotonic() - began
        self._next_update = began + max(_INTERVAL, self._cost / _SHARE)

    def _write_start(self, run: Run) -> None:
        initial = run.full()
        self._initial_error = run.problem.parameter_error(initial)
        files.write_arrays(self._live / "start.npz", _references(run), compress=False)
        files.write_arrays(self._live / "initial.npz", _small(initial), compress=False)
        files.write_arrays(self._live / "parameters.npz", _small(initial), compress=False)
        if run.problem.truth:
            files.write_arrays(self._live / "truth.npz", _small(run.problem.truth), compress=False)
        record = {
            **self._told,
            "name": self._told["name"] or run.problem.name,
            "method": self._told["method"] or type(run.estimator).__name__,
            "settings": {**self._told["settings"], "estimator": repr(run.estimator), "optimizer": repr(run.optimizer)},
            "seed": run.seed,
            "versions": versions(),
            "hardware": hardware(),
            "variant": current() or "",
            "problem": {"parameters": list(initial), "views": len(run.problem.views), "loss": repr(run.problem.loss)},
        }
        _write_json(self._live / "run.json", record)

    def _write_status(self, run: Run, status: str, record: Mapping[str, Any] | None) -> None:
        found = {
            "status": status,
            "stopped": run.stopped,
            "step": run.step,
            "steps": run.steps,
            "seconds": run.clock,
            "budget_seconds": run.seconds,
            "loss": record["loss"] if record else None,
            "samples": record["samples"] if record else 0,
            "skipped": run.skipped,
            "warnings": list(run.warnings),
            "control": self._command[1],
            "process": os.getpid(),
            "host": platform.node(),
            "update_seconds": self._cost,
            "initial_error": self._initial_error,
            "shapes": run.problem.shapes(),
        }
        _write_json(self._live / "status.json", found)

    def _give_up(self, run: Run, error: Exception) -> None:
        self._silent = True
        run.warnings.append(f"the run goes on, but can no longer be watched: {' '.join(str(error).split())}")


class _OwnHistory:
    """Appends to live/history.jsonl as long as nobody writes history.jsonl in the run folder."""

    def __init__(self, folder: Path):
        self._other = folder / "history.jsonl"
        self._records: list[Mapping[str, Any]] = []
        self._before = _stamp(self._other)

    def take(self, record: Mapping[str, Any]) -> None:
        self._records.append(record)

    def write(self, live: Path) -> None:
        path = live / "history.jsonl"
        if _stamp(self._other) != self._before:
            path.unlink(missing_ok=True)
        elif self._records:
            with path.open("ab") as file:
                file.write(lines(self._records))
        self._records.clear()


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def _references(run: Run) -> dict[str, np.ndarray]:
    views = run.problem.views[:_VIEWS]
    return {f"view{i}/reference": reduced(np.asarray(view.reference), _PICTURE) for i, view in enumerate(views)}


def _images(run: Run) -> dict[str, np.ndarray]:
    """{"view0": (H, W, 3)} as the loss saw them, of those views that the estimate tells."""
    info = run.estimate.info if run.estimate is not None else {}
    found = {i: arrays.numpy(image) for i, image in info.get("images", {}).items() if i < _VIEWS}
    wanted = {i: np.asarray(view.reference).shape for i, view in enumerate(run.problem.views)}
    return {f"view{i}": reduced(image, _PICTURE) for i, image in found.items() if image.shape == wanted.get(i)}


def _views(run: Run) -> dict[str, np.ndarray]:
    found = {f"{name}/result": image for name, image in _images(run).items()}
    info = run.estimate.info if run.estimate is not None else {}
    for kind in ("control_weight", "pixel_probability"):
        for i, values in info.get(kind, {}).items():
            if i < _VIEWS and (array := arrays.numpy(values)).ndim in (2, 3):
                size = np.asarray(run.problem.views[i].reference).shape[:2]
                small = reduced(np.empty((*size, 0), np.float32), _PICTURE).shape[:2]
                found[f"view{i}/{kind}"] = resize_nearest(reduced(array, _PICTURE), *small)
    return found


def _small(parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Textures and volumes box-filtered; of other large arrays the least and the greatest value."""
    found = {}
    for key, value in parameters.items():
        array = np.asarray(value)
        if array.ndim == 4:
            array = reduced(array, _VOLUME, 3)
        elif array.ndim in (2, 3) and min(array.shape[:2]) > 1 and array.shape[2:] in ((), (1,), (3,), (4,)):
            array = reduced(array, _PICTURE)
        elif array.size > _WHOLE:
            array = np.array([array.min(), array.max()])
        found[key] = array
    return found


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    files.write(path, lines([value]))
