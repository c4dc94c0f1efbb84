"""The run folder while its run goes: begun before the first step, kept up at every one, whole at every instant."""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomli_w

from unrender.io import files
from unrender.core.errors import InputError
from unrender.problem import serialization
from unrender.problem.problem import Problem
from unrender.runs.folder import checkpoint
from unrender.runs.folder.history import HistoryFile
from unrender.runs.folder.lock import Lock
from unrender.runs.result import Result, deciding_versions
from unrender.runs.folder.state import pack

METHOD, RECORD, HISTORY = "method.toml", "run.json", "history.jsonl"
_OF_A_RUN = (
    *(RECORD, HISTORY, METHOD, serialization.FILE, "parameters.npz", "initial.npz", "truth.npz", "pictures.npz"),
    *("report.html", "control.json"),
)
_EVERY, _AT_LEAST_EVERY = 50, 60.0
_SHARE = 1 / 50
_WATCH_SECONDS = 1.0

_log = logging.getLogger("unrender")


@dataclass
class RunWriter:
    """Writes a run folder. What goes wrong on the way is said once and does not end the run; at the end it raises.

    Args:
        folder: where.
        problem: what is run.
        method: method.toml, see `method_file`.
        every: steps between checkpoints; None for 50 or so: fewer than 50 where they take over a minute, more where writing would cost
            more than a fiftieth of the run's time.
        complain: hears each thing that goes wrong, one line.
    """

    folder: Path
    problem: Problem
    method: Mapping[str, Any]
    every: int | None = None
    complain: Callable[[str], None] = lambda line: None
    _lock: Lock = field(init=False)
    _history: HistoryFile = field(init=False)
    _said: set[str] = field(default_factory=set)
    _begun: bool = False
    _lost: bool = False
    _soon: bool = False
    _watched: float = 0.0
    _written_step: int = -1
    _written_at: float = field(default_factory=time.perf_counter)
    _cost: float = 0.0

    def __post_init__(self) -> None:
        self._lock = Lock(self.folder)
        self._history = HistoryFile(self.folder / HISTORY)

    # ------------------------------------------------------------------ from start to end

    def take(self) -> None:
        """Hold the folder, made where there is none. Raises `InputError` where another process holds it, or it cannot be written."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"run folder {self.folder}: {error.strerror or error}") from error
        self._lock.take()

    def begin(self, result: Result) -> None:
        """Write what a new run starts with, in place of what an earlier one left. Raises `InputError` where that cannot be."""
        try:
            if (self.folder / RECORD).exists() or (self.folder / METHOD).exists():
                _clear(self.folder)
            self._write_start(result)
            self._begun = True
        except OSError as error:
            raise InputError(f"run folder {self.folder}: cannot be written: {error.strerror or error}") from error

    def resume(self, records: Sequence[Mapping[str, Any]], result: Result) -> None:
        """Take up a run that has come as far as `records`: the history is cut there. Raises `InputError` where that cannot be."""
        try:
            checkpoint.sweep(self.folder)
            self._history.cut(records)
            files.write(self.folder / METHOD, method_text(self.method))
            self._write_record(result, "running")
            self._written_step, self._begun = len(records), True
        except OSError as error:
            raise InputError(f"run folder {self.folder}: cannot be written: {error.strerror or error}") from error

    def step(self, record: Mapping[str, Any]) -> None:
        """Take down one step."""
        self._guarded("history", lambda: self._history.append(record))
        now = time.perf_counter()
        if now - self._watched >= _WATCH_SECONDS:
            self._watched = now
            self._soon = self._soon or not (self._lost or self._lock.is_ours())

    def is_due(self, step: int) -> bool:
        """Whether to write a checkpoint now."""
        if self._soon:
            return True
        if self.every is not None:
            return step % self.every == 0
        since = time.perf_counter() - self._written_at
        return (step % _EVERY == 0 or since >= _AT_LEAST_EVERY) and since * _SHARE >= self._cost

    def checkpoint(self, result: Result, seed: int, state: Any) -> None:
        """Write one of the state after `result.steps` steps, and what has been reached so far."""
        if result.steps == self._written_step and not self._soon:
            return
        started = time.perf_counter()
        self._soon = False
        self._guarded("checkpoint", lambda: self._write_checkpoint(result, seed, state))
        self._written_at = time.perf_counter()
        self._cost = self._written_at - started

    def save(self, result: Result, status: str) -> None:
        """Write the result. Raises `InputError` where it cannot be written."""
        self._stand_fast(result)
        if self._lost:
            raise InputError(f"run folder {self.folder}: another run has taken its place; the result is not saved")
        result.save(self.folder, status)

    def fail(self, result: Result, error: BaseException) -> None:
        """Note that the run ended by an exception; nothing where it had not begun, or the folder is no longer ours."""
        if not self._begun or not self._lock.is_ours():
            return
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        serialize = " ".join(str(error).split())[:300] or type(error).__name__
        self._guarded("end", lambda: self._write_record(result, status, serialize))

    def close(self) -> None:
        """Let the folder go."""
        self._history.close()
        self._lock.release()

    # ------------------------------------------------------------------ the writing

    def _write_start(self, result: Result) -> None:
        serialization.save(self.problem, self.folder)
        files.write(self.folder / METHOD, method_text(self.method))
        files.write_arrays(self.folder / "initial.npz", result.initial)
        if result.truth:
            files.write_arrays(self.folder / "truth.npz", result.truth)
        files.write_arrays(self.folder / "parameters.npz", result.parameters)
        self._history.cut(result.history)
        self._write_record(result, "running")

    def _write_record(self, result: Result, status: str, error: str = "") -> None:
        text = json.dumps(result.record(status) | ({"error": error} if error else {}), indent=2) + "\n"
        files.write(self.folder / RECORD, text.encode())

    def _write_checkpoint(self, result: Result, seed: int, state: Any) -> None:
        self._stand_fast(result)
        if self._lost:
            return
        self._history.sync()
        problem = result.problem["fingerprint"]
        checkpoint.write(self.folder, result.steps, seed, pack(state), deciding_versions(), problem)
        files.write_arrays(self.folder / "parameters.npz", result.parameters, compress=False)
        self._write_record(result, "running")
        self._written_step = result.steps

    def _stand_fast(self, result: Result) -> None:
        """See that the folder is still there and ours; make it again where it was deleted."""
        if self._lost or self._lock.is_ours():
            return
        if self._lock.path.exists():
            self._lost = True
            self._say(
                f"run folder {self.folder}: deleted, and another run has taken its place; nothing more is written"
            )
            return
        self._history.close()
        self._lock.release()
        self.take()
        self._write_start(result)
        self._say(
            f"run folder {self.folder}: deleted while the run goes; it was made again, without the earlier checkpoints"
        )

    def _guarded(self, what: str, write: Callable[[], None]) -> None:
        try:
            write()
        except (OSError, InputError, TypeError) as error:
            serialize = (error.strerror if isinstance(error, OSError) else "") or str(error)
            self._say(f"run folder {self.folder}: {what} not written: {serialize}; the run goes on", f"{what} {serialize[-60:]}")

    def _say(self, line: str, once: str = "") -> None:
        if (once or line) not in self._said:
            self._said.add(once or line)
            self.complain(line)
            _log.warning(line)


def method_text(method: Mapping[str, Any]) -> bytes:
    """method.toml."""
    return ("# The run: its method, budget and seed\n" + tomli_w.dumps(dict(method))).encode()


def _clear(folder: Path) -> None:
    """Remove what an earlier run left, and nothing else."""
    for name in _OF_A_RUN:
        (folder / name).unlink(missing_ok=True)
    checkpoint.clear(folder)
    checkpoint.sweep(folder)
    for name in (serialization.ARRAYS, "live"):
        place = folder / name
        if place.is_dir() and not place.is_symlink() and not os.path.ismount(place):
            shutil.rmtree(place, ignore_errors=True)
