"""Writer of a run folder: created before the first step, updated at every step, and consistent at every instant.

Everything but the history is on disk before it is renamed, and the history before a checkpoint refers to it. So a power cut leaves what a
kill would have left at the last checkpoint, or later.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unrender.backend.versions import deciding_versions
from unrender.core import phases, timing
from unrender.core.errors import InputError
from unrender.core.text import reason_of
from unrender.io import files
from unrender.optimizers.base import Measuring
from unrender.runs import callbacks
from unrender.runs.budget import LEAST_NUMBERS, can_test, cost_of_end
from unrender.runs.callbacks import Callback
from unrender.runs.final_checks import at_start, with_misfit
from unrender.runs.final_images import render_final_images, warm_up
from unrender.runs.folder import checkpoint, contents, method_file
from unrender.runs.folder.history import THINNED_FROM, HistoryFile, thinned
from unrender.runs.folder.lock import Lock
from unrender.runs.folder.meshes import FOLDER as MESH_FILES
from unrender.runs.folder.meshes import write_files
from unrender.runs.folder.schema import (
    CONTROL,
    DATA_SHARE,
    ENDED,
    HISTORY,
    INITIAL,
    LAST,
    LIVE,
    MESHES,
    METHOD,
    MISFIT,
    PARAMETERS,
    PICTURES,
    RECORD,
    REPORT,
    SENSITIVITY,
    STANDARD_ERROR,
    TRUTH,
)
from unrender.runs.folder.state import not_finite, pack
from unrender.runs.loop import WARM_UP_STEPS
from unrender.runs.result import TERMINATED, Result
from unrender.runs.truth_check import has_few_steps, with_few_steps
from unrender.runs.verification import fit_status
from unrender.scene import serialization

if TYPE_CHECKING:
    from unrender.runs.run import Run

_FILES = (
    *(RECORD, HISTORY, METHOD, serialization.FILE, PARAMETERS, INITIAL, TRUTH, PICTURES, SENSITIVITY, MESHES, LAST),
    *(REPORT, CONTROL, STANDARD_ERROR, DATA_SHARE),
)
_STEPS, _MOST_SECONDS = 50, 60.0
_SHARE = 1 / 100
_CHECK_SECONDS = 1.0
_EXPORT = "scene"

_log = logging.getLogger("unrender")


@dataclass
class RunWriter(Callback):
    """Callback that writes a run folder: the history at every step, checkpoints, and the result with final images.

    A failure during the run is a warning, issued once, and does not end the run; a failure at the end raises. As a context manager it
    holds the folder's lock; `start` or `resume` must be called before the run.

    Args:
        save_problem: function that writes the problem's file into a folder.
        method: contents of method.toml, see `method_file`.
        checkpoint_every: steps between checkpoints. None takes about 50: fewer if they take over a minute, more if writing would take
            over a hundredth of the run's time.
        final_spp: samples per pixel of the final images; None chooses.
        warn: function that is called with a line for each failure.
    """

    folder: Path
    save_problem: Callable[[Path], None]
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
        """Lock the folder, and create it if missing. Raises `InputError` if another process holds it, or it is not writable."""
        self._acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self._history.close()
        self._lock.release()

    def start(self, result: Result) -> None:
        """Write the initial files of a new run, and remove those of an earlier run.

        Raises `InputError` if they cannot be written. It is also raised if they could not be read again; the earlier run is then still
        there.
        """
        contents.check_writable(self.folder, result, "running")
        method_file.encode(self.method, self.folder / METHOD)
        with self._writing():
            try:
                if (self.folder / RECORD).exists() or (self.folder / METHOD).exists():
                    _clear(self.folder)
                _sweep(self.folder)
                self._write_start(result)
                self._started = True
            except (KeyboardInterrupt, InputError):
                with contextlib.suppress(OSError):
                    _clear(self.folder)  # files without run.json are not recognised as a run
                raise

    def resume(self, records: Sequence[Mapping[str, Any]], result: Result) -> None:
        """Continue after `records`, with which the history is rewritten. Raises `InputError` if that fails."""
        with self._writing():
            _sweep(self.folder)
            self._history.rewrite(records)
            files.write(self.folder / METHOD, method_file.encode(self.method, self.folder / METHOD))
            contents.write_record(self.folder, result, "running")
            self._written_step, self._started = result.steps, True

    def on_warm_up(self, run: Run, fresh: dict[str, Any], warm: dict[str, Any]) -> None:
        """Compile the kernels of the final pictures, so that nothing compiles after the last step. Write another plan of the run."""
        if run.replanned:
            self.method = method_file.serialize(run, self.method["name"], self.checkpoint_every, self.final_spp)
            with self._writing():
                self._write_method(run.result())
        if self.final_spp != 1 and not run.stopped:
            run.tested = can_test(run)
            with phases.phase(callbacks.COMPILING):
                steps = run.steps or 0
                samples = steps * warm["samples"] / WARM_UP_STEPS
                counted = math.inf if run.seconds else cost_of_end(samples, steps, LEAST_NUMBERS)
                warm_up(run.problem, run.full(), run.tested, counted)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        self.append(record)
        if self._history.size > max(THINNED_FROM, self._thin_from):
            self._guarded("history", lambda: self._thin(run.history))
        if self.checkpoint_due(run.step):
            self.write_checkpoint(run)

    def on_result(self, run: Run, result: Result) -> Result:
        """Write the last checkpoint and the result, render the final images, and write the result with them.

        A terminated run has no final images, because its caller waits for seconds only.
        """
        self.write_checkpoint(run, result)
        if result.stopped != TERMINATED:
            if result.status not in ENDED or self._written_step != result.steps:
                # Save the long computation and its outcome before the final images take more time.
                self._save(result, "running" if result.status in ENDED else result.status)
            started = time.perf_counter()
            complete = isinstance(run.optimizer, Measuring)
            allowed = cost_of_end(run.state.samples, run.step)

            def left() -> float:
                return run.time_left() if run.seconds is not None else allowed - timing.now()

            given = self.final_spp, left, run.tested, result.pixel_weights, complete, run.grace
            with timing.counting(run.seconds is None):
                images = render_final_images(run.problem, result, *given)
                if images.rise:
                    result = at_start(result, images.rise)
                    images = render_final_images(run.problem, result, *given)
            result, verification = with_misfit(result, images.misfit), dict(result.verification)
            if verification and verification["status"] in ("finished", MISFIT):
                few = has_few_steps(result.steps, run.optimizer)
                verification["status"] = fit_status(run.problem, "finished", result.misfit, few)
            result = replace(
                result,
                pictures=images.pictures,
                image_errors=images.errors,
                sensitivity=images.sensitivity,
                data_share=images.data_share,
                undetermined=images.undetermined,
                without_errors=images.without_errors,
                standard_error=images.standard_error,
                warnings=[*result.warnings, *images.warnings],
                verification=verification,
            )
            result = with_few_steps(run.problem, result)
            result = callbacks.with_phase(result, callbacks.PICTURES, time.perf_counter() - started)
        self._save(result, result.status)
        self._guarded("meshes", lambda: write_files(self.folder, run.problem, result.parameters), "")
        return result

    def on_error(self, run: Run, error: BaseException) -> None:
        """Record that the run ended by an exception, if it had started and still holds the folder."""
        if not self._started or not self._lock.is_held():
            return
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        message = reason_of(error, 300)
        self._guarded("end", lambda: contents.write_record(self.folder, run.result(), status, message), "")

    # ------------------------------------------------------------------ the parts of a step

    def append(self, record: Mapping[str, Any]) -> None:
        """Append one step to the history."""
        self._guarded("history", lambda: self._history.append(record))
        now = time.perf_counter()
        if now - self._checked_at >= _CHECK_SECONDS:
            self._checked_at = now
            self._checkpoint_at_once |= not (self._taken_over or self._lock.is_held())

    def checkpoint_due(self, step: int) -> bool:
        """Return whether a checkpoint is due."""
        if self._checkpoint_at_once:
            return True
        if self.checkpoint_every is not None:
            return step % self.checkpoint_every == 0
        since = time.perf_counter() - self._written_at
        return (step % _STEPS == 0 or since >= _MOST_SECONDS) and since * _SHARE >= self._cost

    def write_checkpoint(self, run: Run, result: Result | None = None) -> None:
        """Write a checkpoint after the last step with `result`, by default the current one; at most once per step."""
        result = result or run.result()
        if run.problem.remeshed_from is not None:
            return  # the last checkpoint precedes remeshing: a resumed run remeshes again, to the same mesh
        if result.steps == self._written_step and not self._checkpoint_at_once:
            return
        started = time.perf_counter()
        state = run.snapshot()  # takes time if workers hold a part of it
        self._checkpoint_at_once = False
        self._guarded("checkpoint", lambda: self._write_checkpoint(result, run.seed, state))
        self._written_at = time.perf_counter()
        self._cost = self._written_at - started

    # ------------------------------------------------------------------ the writing

    def _writing(self) -> contextlib.AbstractContextManager[None]:
        return files.input_errors(f"run folder {self.folder}: cannot be written")

    def _acquire(self) -> None:
        with files.input_errors(f"run folder {self.folder}"):
            files.make_folder(self.folder)
        self._lock.acquire()

    def _save(self, result: Result, status: str) -> None:
        self._restore_folder(result)
        if self._taken_over:
            raise InputError(f"run folder {self.folder}: another run has taken its place; the result is not saved")
        contents.write_result(self.folder, result, status)

    def _write_start(self, result: Result) -> None:
        self.save_problem(self.folder)
        self._write_method(result)

    def _write_method(self, result: Result) -> None:
        """Write all initial files that depend on the method."""
        files.write(self.folder / METHOD, method_file.encode(self.method, self.folder / METHOD), name_too=False)
        contents.write_arrays(self.folder, result, (INITIAL, TRUTH, MESHES, PARAMETERS))
        self._history.rewrite(result.history, name_too=False)
        files.sync_folder(self.folder)
        contents.write_record(self.folder, result, "running")

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
        contents.write_record(self.folder, result, "running")
        self._written_step = result.steps

    def _thin(self, records: list[dict[str, Any]]) -> None:
        thinned_records = thinned(records)
        # Avoids an attempt at every step if thinning has no effect.
        self._thin_from = self._history.size + THINNED_FROM // 8
        if len(thinned_records) < len(records):
            records[:] = thinned_records
            self._history.rewrite(records)
            self._thin_from = 0

    def _restore_folder(self, result: Result) -> None:
        """Check that the folder still exists and is locked; recreate it if it was deleted."""
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
            f"run folder {self.folder}: deleted during the run; it was created again, without the earlier checkpoints"
        )

    def _guarded(self, what: str, write: Callable[[], None], after: str = "; the run continues") -> None:
        try:
            write()
        except (OSError, InputError, TypeError) as error:
            reason = (error.strerror if isinstance(error, OSError) else "") or str(error)
            line = f"run folder {self.folder}: {what} not written: {reason}{after}"
            self._warn_once(line, f"{what} {reason[-60:]}")

    def _warn_once(self, line: str, topic: str = "") -> None:
        if (topic or line) not in self._warned:
            self._warned.add(topic or line)
            self.warn(line)
            _log.warning(line)


def _clear(folder: Path) -> None:
    for name in _FILES:
        (folder / name).unlink(missing_ok=True)
    checkpoint.clear(folder)
    for name in (serialization.ARRAYS, LIVE, MESH_FILES):
        place = folder / name
        if place.is_dir() and not place.is_symlink() and not os.path.ismount(place):
            shutil.rmtree(place, ignore_errors=True)


def _sweep(folder: Path) -> None:
    """Remove what dead processes left half-written: runs, reports, and exports at their default place."""
    files.remove_leftovers(folder, (*_FILES, _EXPORT))
    for name in (serialization.ARRAYS, LIVE, MESH_FILES):
        files.remove_leftovers(folder / name)
    checkpoint.remove_partial(folder)
