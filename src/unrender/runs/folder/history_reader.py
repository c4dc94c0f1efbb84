"""history.jsonl by columns: all of it, or what was added since one looked last."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.io import bounded_files

LONGEST_LINE = 1 << 20
"""In bytes."""
LONGEST = 1 << 30
"""Of the whole file, in bytes."""
_CHUNK = 1 << 20


@dataclass(frozen=True)
class ErrorHistory:
    """One parameter's root mean square error where it was recorded; arrays of equal length.

    Attributes:
        records: which of the history's records, ascending.
        values: >= 0; infinite where the record holds no number.
    """

    records: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class History:
    """history.jsonl, by columns of one length.

    Attributes:
        seconds, samples: since the start, ascending.
        loss, gradient_noise: NaN where the record holds no number.
        parameter_error: {key: where and what}.
    """

    seconds: np.ndarray
    samples: np.ndarray
    loss: np.ndarray
    gradient_noise: np.ndarray
    parameter_error: dict[str, ErrorHistory]

    def __len__(self) -> int:
        return len(self.seconds)


@dataclass
class Reader:
    """Reads a history that may still grow. A file that was replaced or cut is read anew.

    Attributes:
        path: the file.
        folder: the run folder that it must lie in.
    """

    path: Path
    folder: Path
    _columns: dict[str, list[float]] = field(default_factory=dict)
    _errors: dict[str, tuple[list[int], list[float]]] = field(default_factory=dict)
    _line: int = 0
    _offset: int = 0
    _rest: bytes = b""
    _file: tuple[int, int] = (0, 0)

    def __post_init__(self):
        self._begin()

    def read(self, to_the_end: bool = True) -> History:
        """What the file holds now.

        Args:
            to_the_end: also a last line without a line break. A run that goes on may be writing it: then leave it.

        Raises:
            InputError: the file is missing, too large, or a line of it is malformed; the file and the line are named.
        """
        with bounded_files.opened(self.path, self.folder) as file:
            status = os.fstat(file.fileno())
            if (status.st_dev, status.st_ino) != self._file or status.st_size < self._offset:
                self._begin()
                self._file = status.st_dev, status.st_ino
            if status.st_size > LONGEST:
                raise InputError(f"{self.path}: larger than {LONGEST >> 30} GiB, which no run writes")
            file.seek(self._offset)
            try:
                while data := file.read(_CHUNK):
                    self._offset += len(data)
                    self._take(data)
                if to_the_end and self._rest:
                    self._take(b"\n")
            except InputError:
                self._begin()  # so that the next call says the same, and does not go on behind the line
                raise
        return self._history()

    def _begin(self) -> None:
        self._columns = {"seconds": [], "samples": [], "loss": [], "gradient_noise": []}
        self._errors = {}
        self._line, self._offset, self._rest, self._file = 0, 0, b"", (0, 0)

    def _take(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._line += 1
            self._record(line)
        if len(self._rest) > LONGEST_LINE:
            raise InputError(f"{self.path}:{self._line + 1}: a line of more than {LONGEST_LINE >> 20} MiB")

    def _record(self, line: bytes) -> None:
        if not line.strip():
            return
        where = f"{self.path}:{self._line}"
        if len(line) > LONGEST_LINE:
            raise InputError(f"{where}: a line of more than {LONGEST_LINE >> 20} MiB")
        try:
            record = bounded_files.parse(line.decode("utf-8-sig" if self._line == 1 else "utf-8"), where)
        except UnicodeDecodeError as error:
            raise InputError(f"{where}: not UTF-8 text ({error.reason} at byte {error.start})") from error
        found = {name: _number(record.get(name), f"{where}: {name}", name in _AXES) for name in self._columns}
        for name in _AXES:
            last = self._columns[name][-1] if self._columns[name] else 0.0
            if found[name] < last:
                raise InputError(f"{where}: {name}: expected no less than {last:g} before it, got {found[name]:g}")
        errors = record.get("parameter_error", {})
        if not isinstance(errors, dict):
            raise InputError(f"{where}: parameter_error: expected an object {{key: number}}, got {_short(errors)}")
        values = {
            key: _number(value, f"{where}: parameter_error.{bounded_files.shown(key)}", False)
            for key, value in errors.items()
        }
        for name, column in self._columns.items():
            column.append(found[name])
        for key, value in values.items():
            at, of = self._errors.setdefault(key, ([], []))
            at.append(len(self._columns["seconds"]) - 1)
            of.append(value if math.isfinite(value) else math.inf)

    def _history(self) -> History:
        return History(
            **{name: np.array(column, float) for name, column in self._columns.items()},
            parameter_error={
                key: ErrorHistory(np.array(r, int), np.array(v, float)) for key, (r, v) in self._errors.items()
            },
        )


_AXES = ("seconds", "samples")


def _number(value: Any, where: str, required: bool) -> float:
    if value is None and not required:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: expected a number, got {_short(value)}")
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if required and not math.isfinite(found):
        raise InputError(f"{where}: expected a finite number, got {_short(value)}")
    return found if math.isfinite(found) else math.nan


def _short(value: Any) -> str:
    return bounded_files.shown(repr(value)) if value is not None else "nothing"
