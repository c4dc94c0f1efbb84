"""The run folder while its run goes: begun before the first step, kept up at every one, whole at every instant.

All but the history is on the disk when it has its name, and the history when a checkpoint counts on it: so what a power cut leaves is what
a kill would have left at the last checkpoint, or later.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unrender.core import phases
from unrender.core.errors import InputError
from unrender.core.text import reason_of
from unrender.io import files
from unrender.runs import phase_times
from unrender.runs.final_images import render_final_images, warm_up
from unrender.runs.folder import checkpoint, method_file
from unrender.runs.folder.history import MOST_KEPT, HistoryFile, thinned
from unrender.runs.folder.lock import Lock
from unrender.runs.folder.meshes import FOLDER as MESH_FILES
from unrender.runs.folder.meshes import write_files
from unrender.runs.folder.schema import (
    CONTROL,
    ENDED,
    HISTORY,
    INITIAL,
    LAST,
    LIVE,
    MESHES,
    METHOD,
    PARAMETERS,
    PICTURES,
    RECORD,
    REPORT,
    SENSITIVITY,
    TRUTH,
)
from unrender.runs.folder.state import not_finite, pack
from unrender.runs.hooks import Hook
from unrender.runs.result import PRUNED, TERMINATED, Result, deciding_versions
from unrender.scene import serialization
from unrender.scene.problem import Problem

if TYPE_CHECKING:
    from unrender.runs.loop import Descent

_FILES = (
    *(RECORD, HISTORY, METHOD, serialization.FILE, PARAMETERS, INITIAL, TRUTH, PICTURES, SENSITIVITY, MESHES, LAST),
    *(REPORT, CONTROL),
)
_STEPS, _MOST_SECONDS = 50, 60.0
_SHARE = 1 / 100
_CHECK_SECONDS = 1.0
_EXPORT = "scene"

_log = logging.getLogger("unrender")


@dataclass
class RunWriter(Hook):
    """Writes a run folder: the history at every step, checkpoints, and the result with final pictures.

    What goes wrong on the way is a warning, once, and does not end the run; at the end it raises. As a context manager it holds the
    folder's lock; `start` or `resume` must follow before the descent.

    Args:
        folder: where.
        problem: what is run.
        method: method.toml, see `method_file`.
        checkpoint_every: steps between checkpoints; None for 50 or so: fewer than 50 where they take over a minute, more where writing
            would cost more than a hundredth of the run's time.
        final_spp: samples per pixel of the final pictures; None chooses.
        warn: called with each thing that goes wrong, one line.
    """

    folder: Path
    problem: Problem
    method: Mapping[str, Any]
    checkpoint_every: int | None = None
    final_spp: int | None = None
    warn: Callable[[str], None] = lambda line: None
    _lock: Lock = field(init=False)
    _history: HistoryFile = field(init=False)
    _warned: set[str] = field(default_factory=set)
    _started: bool = False
    _taken_over: bool = False
    _checkpoint_at_once: bool = False
    _checked_at: float = 0.0
    _written_step: int = -1
    _written_at: float = field(default_factory=time.perf_counter)
    _cost: float = 0.0
    _thin_from: int = 0

    def __post_init__(self) -> None:
        self._lock = Lock(self.folder)
        self._history = HistoryFile(self.folder / HISTORY)

    # ------------------------------------------------------------------ from start to end

    def __enter__(self) -> RunWriter:
        """Lock the folder, made where there is none. Raises `InputError` where another process holds it, or it cannot be written."""
        self._acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self._history.close()
        self._lock.release()

    def start(self, result: Result) -> None:
        """Write what a new run starts with, in place of what an earlier one left.

        Raises `InputError` where that cannot be, and where the files could not be read again: before an earlier run is removed.
        """
        self._check(result)
        try:
            if (self.folder / RECORD).exists() or (self.folder / METHOD).exists():
                _clear(self.folder)
            _sweep(self.folder)
            self._write_start(result)
            self._started = True
        except OSError as error:
            raise InputError(f"run folder {self.folder}: cannot be written: {error.strerror or error}") from error
        except (KeyboardInterrupt, InputError):
            with contextlib.suppress(OSError):
                _clear(self.folder)  # what is whole but for run.json nothing would take for a run
            raise

    def resume(self, records: Sequence[Mapping[str, Any]], result: Result) -> None:
        """Go on after `records`, with which the history is rewritten. Raises `InputError` where that cannot be."""
        try:
            _sweep(self.folder)
            self._history.rewrite(records)
            files.write(self.folder / METHOD, method_file.encode(self.method, self.folder / METHOD))
            self._write_record(result, "running")
            self._written_step, self._started = result.steps, True
        except OSError as error:
            raise InputError(f"run folder {self.folder}: cannot be written: {error.strerror or error}") from error

    def on_warm_up(self, descent: Descent, fresh: dict[str, Any], warm: dict[str, Any]) -> None:
        """Compile the kernels of the final pictures, so that nothing compiles after the last step."""
        del fresh, warm
        if self.final_spp != 1 and not descent.run.stopped:
            with phases.phase(phase_times.COMPILING):
                warm_up(descent.run.problem, descent.run.full())

    def on_step(self, descent: Descent, record: dict[str, Any]) -> None:
        """Append the step to the history; write a checkpoint where one is due."""
        self.append(record)
        if self._history.size > max(MOST_KEPT, self._thin_from):
            self._guarded("history", lambda: self._thin(descent.log.history))
        if self.checkpoint_due(descent.run.step):
            self.write_checkpoint(descent)

    def on_result(self, descent: Descent, result: Result) -> Result:
        """Write the last checkpoint and the result, render the final pictures, and write the result with them.

        Without pictures for a run that was told to terminate, since whoever did waits for seconds at most, and for one that was pruned.
        """
        self.write_checkpoint(descent, result)
        if result.stopped not in (TERMINATED, PRUNED):
            if result.status not in ENDED or self._written_step != result.steps:
                # What took long is safe, and how it ended is known, before what takes seconds more.
                self._save(result, "running" if result.status in ENDED else result.status)
            started = time.perf_counter()
            images = render_final_images(descent.run.problem, result, self.final_spp, descent.run.time_left)
            result = replace(
                result,
                pictures=images.pictures,
                image_errors=images.errors,
                sensitivity=images.sensitivity,
                undetermined=images.undetermined,
                warnings=[*result.warnings, *images.warnings],
            )
            result = phase_times.with_phase(result, phase_times.PICTURES, time.perf_counter() - started)
        self._save(result, result.status)
        self._guarded("meshes", lambda: write_files(self.folder, descent.run.problem, result.parameters))
        return result

    def on_error(self, descent: Descent, error: BaseException) -> None:
        """Note that the run ended by an exception; nothing where it had not started, or the folder is held by another run."""
        if not self._started or not self._lock.is_held():
            return
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        message = reason_of(error, 300)
        self._guarded("end", lambda: self._write_record(descent.result(), status, message))

    # ------------------------------------------------------------------ the parts of a step

    def append(self, record: Mapping[str, Any]) -> None:
        """Append one step to the history."""
        self._guarded("history", lambda: self._history.append(record))
        now = time.perf_counter()
        if now - self._checked_at >= _CHECK_SECONDS:
            self._checked_at = now
            self._checkpoint_at_once |= not (self._taken_over or self._lock.is_held())

    def checkpoint_due(self, step: int) -> bool:
        """Whether to write a checkpoint now."""
        if self._checkpoint_at_once:
            return True
        if self.checkpoint_every is not None:
            return step % self.checkpoint_every == 0
        since = time.perf_counter() - self._written_at
        return (step % _STEPS == 0 or since >= _MOST_SECONDS) and since * _SHARE >= self._cost

    def write_checkpoint(self, descent: Descent, result: Result | None = None) -> None:
        """Write a checkpoint after the last step, and `result`, by default what has been reached so far; once per step."""
        result = result or descent.result()
        if descent.run.problem.remeshed_from is not None:
            return  # the last one is from before: a resumed run remeshes once more, to the same mesh
        if result.steps == self._written_step and not self._checkpoint_at_once:
            return
        started = time.perf_counter()
        state = descent.snapshot()  # which takes time where workers hold a part of it
        self._checkpoint_at_once = False
        self._guarded("checkpoint", lambda: self._write_checkpoint(result, descent.run.seed, state))
        self._written_at = time.perf_counter()
        self._cost = self._written_at - started

    # ------------------------------------------------------------------ the writing

    def _acquire(self) -> None:
        try:
            files.make_folder(self.folder)
        except OSError as error:
            raise InputError(f"run folder {self.folder}: {error.strerror or error}") from error
        self._lock.acquire()

    def _save(self, result: Result, status: str) -> None:
        """Write the result. Raises `InputError` where it cannot be written."""
        self._restore_folder(result)
        if self._taken_over:
            raise InputError(f"run folder {self.folder}: another run has taken its place; the result is not saved")
        result.save(self.folder, status)

    def _check(self, result: Result) -> None:
        """Raise `InputError` where the reader would refuse what this run writes."""
        result.encoded_record("running", "", self.folder / RECORD)
        method_file.encode(self.method, self.folder / METHOD)
        for key in result.parameters:
            files.check_member(key, f"run folder {self.folder}: parameter")

    def _write_start(self, result: Result) -> None:
        serialization.save(self.problem, self.folder)
        files.write(self.folder / METHOD, method_file.encode(self.method, self.folder / METHOD), name_too=False)
        files.write_arrays(self.folder / INITIAL, result.initial, name_too=False)
        for name, values in ((TRUTH, result.truth), (MESHES, result.meshes)):
            if values:
                files.write_arrays(self.folder / name, values, name_too=False)
        files.write_arrays(self.folder / PARAMETERS, result.parameters, name_too=False)
        self._history.rewrite(result.history, name_too=False)
        files.sync_folder(self.folder)
        self._write_record(result, "running")

    def _write_record(self, result: Result, status: str, error: str = "") -> None:
        files.write(self.folder / RECORD, result.encoded_record(status, error, self.folder / RECORD))

    def _write_checkpoint(self, result: Result, seed: int, state: Any) -> None:
        self._restore_folder(result)
        if self._taken_over:
            return
        if where := not_finite(state["optimizer"], "optimizer"):
            raise InputError(f"the state holds numbers that are not finite ({where}); the one before stays the last")
        self._history.sync()
        problem = result.problem["fingerprint"]
        checkpoint.write(self.folder, result.steps, seed, pack(state), deciding_versions(), problem)
        files.write_arrays(self.folder / PARAMETERS, result.parameters, compress=False, name_too=False)
        self._write_record(result, "running")
        self._written_step = result.steps

    def _thin(self, records: list[dict[str, Any]]) -> None:
        """Keep fewer records of the earlier steps, in memory and in the file."""
        kept = thinned(records)
        self._thin_from = self._history.size + MOST_KEPT // 8  # not at every step where it is of no use, or fails
        if len(kept) < len(records):
            records[:] = kept
            self._history.rewrite(records)
            self._thin_from = 0

    def _restore_folder(self, result: Result) -> None:
        """See that the folder is still there and locked; make it again where it was deleted."""
        if self._taken_over or self._lock.is_held():
            return
        if self._lock.path.exists():
            self._taken_over = True
            self._warn_once(
                f"run folder {self.folder}: deleted, and another run has taken its place; nothing more is written"
            )
            return
        self._history.close()
        self._lock.release()
        self._acquire()
        self._write_start(result)
        self._warn_once(
            f"run folder {self.folder}: deleted while the run goes; it was made again, without the earlier checkpoints"
        )

    def _guarded(self, what: str, write: Callable[[], None]) -> None:
        try:
            write()
        except (OSError, InputError, TypeError) as error:
            reason = (error.strerror if isinstance(error, OSError) else "") or str(error)
            line = f"run folder {self.folder}: {what} not written: {reason}; the run goes on"
            self._warn_once(line, f"{what} {reason[-60:]}")

    def _warn_once(self, line: str, topic: str = "") -> None:
        if (topic or line) not in self._warned:
            self._warned.add(topic or line)
            self.warn(line)
            _log.warning(line)


def _clear(folder: Path) -> None:
    """Remove what an earlier run left, and nothing else."""
    for name in _FILES:
        (folder / name).unlink(missing_ok=True)
    checkpoint.clear(folder)
    for name in (serialization.ARRAYS, LIVE, MESH_FILES):
        place = folder / name
        if place.is_dir() and not place.is_symlink() and not os.path.ismount(place):
            shutil.rmtree(place, ignore_errors=True)


def _sweep(folder: Path) -> None:
    """Remove what processes that died left half-written: runs, reports, and exports to where they go by default."""
    files.remove_leftovers(folder, (*_FILES, _EXPORT))
    for name in (serialization.ARRAYS, LIVE, MESH_FILES):
        files.remove_leftovers(folder / name)
    checkpoint.remove_partial(folder)
