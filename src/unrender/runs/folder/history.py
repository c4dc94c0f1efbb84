"""history.jsonl: one line a step, written as soon as the step is done; and read, whole or as it grows.

A run of millions of steps keeps fewer lines of its earlier ones (`thinned`), so that no file grows past what is read in seconds.
"""

from __future__ import annotations

import codecs
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import printable
from unrender.io import bounded_files, files
from unrender.runs.folder.schema import HISTORY_AXES, HISTORY_COLUMNS

LARGEST_LINE = 1 << 20
"""In bytes."""
LARGEST = 1 << 30
"""Of the whole file, in bytes."""
MOST_KEPT = 1 << 26
"""Bytes of a run's file from which on its earlier steps are thinned."""
_CHUNK = 1 << 20


# ---------------------------------------------------------------------- records


def steps_in(records: Sequence[Mapping[str, Any]]) -> int:
    """How many steps a history is of, those among them whose records were thinned out."""
    return max(int(records[-1].get("step", 0)) + 1, len(records)) if records else 0


def thinned(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The records with about every second of the earlier three quarters left out.

    Of those the ones remain whose step is a multiple of twice the first ones' stride, and those that record a change of resolution: a
    history that is thinned time and again stays evenly spaced, by powers of two.
    """
    early = len(records) - len(records) // 4
    if early < 2:
        return list(records)
    stride = 1
    while all(record["step"] % (2 * stride) == 0 for record in records[: early // 2] if "resolution" not in record):
        stride *= 2
        if stride > records[-1]["step"]:
            return list(records)
    kept = [r for r in records[:early] if r["step"] % (2 * stride) == 0 or "resolution" in r]
    return [*kept, *records[early:]]


# ---------------------------------------------------------------------- writing


class HistoryFile:
    """The file while the run goes. A line that could not be written is held back, and written with the next."""

    def __init__(self, path: Path):
        self.path = path
        self._file: int | None = None
        self._pending: list[bytes] = []
        self.size = 0
        """Of the file, in bytes."""

    def rewrite(self, records: Iterable[Mapping[str, Any]], name_too: bool = True) -> None:
        """Make the file hold just these, and go on from there; see `files.write`.

        Raises `OSError` or `InputError`; the file is then as it was.
        """
        text = lines(records)
        files.write(self.path, text, name_too=name_too)
        opened = os.open(self.path, os.O_WRONLY | os.O_CLOEXEC)
        self.close()
        self._file, self.size, self._pending = opened, len(text), []

    def append(self, record: Mapping[str, Any]) -> None:
        """Add one line. Raises `OSError`; the file then ends with the last whole line."""
        self._pending.append(lines([record]))
        if self._file is None:
            raise OSError("the file is closed")
        data = b"".join(self._pending)
        written = 0
        try:
            while written < len(data):
                written += os.pwrite(self._file, data[written:], self.size + written)
        except OSError:
            if written:
                os.ftruncate(self._file, self.size)
            raise
        self.size += len(data)
        self._pending = []

    def sync(self) -> None:
        """Have it on the disk before this returns. Raises `OSError`."""
        if self._file is not None:
            files.flush(self._file)

    def close(self) -> None:
        """Harmless where it is closed."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def lines(records: Iterable[Mapping[str, Any]]) -> bytes:
    """The records as JSON, one a line; numbers that are not finite become null."""
    return "".join(json.dumps(_finite_or_null(record), allow_nan=False) + "\n" for record in records).encode()


def _finite_or_null(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite_or_null(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite_or_null(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


# ---------------------------------------------------------------------- reading records, to go on from them


def read_records(path: Path, folder: Path) -> tuple[list[dict[str, Any]], str]:
    """The records of a history up to the first line that is no record of a later step, and what is wrong with that line, "" for nothing.

    A last line that was cut off is nothing wrong. Raises `InputError` where the file cannot be read, or is larger than `LARGEST`.
    """
    found: list[dict[str, Any]] = []
    with bounded_files.open_regular(path, folder) as file:
        if os.fstat(file.fileno()).st_size > LARGEST:
            raise InputError(f"{path}: larger than {LARGEST >> 30} GiB, which no run writes")
        while (line := file.readline(LARGEST_LINE + 1)).endswith(b"\n"):
            where = f"{path}:{len(found) + 1}"
            try:
                record = bounded_files.parse_json(line.removeprefix(codecs.BOM_UTF8 if not found else b""), where)
            except InputError as error:
                return found, str(error)
            step = record.get("step") if isinstance(record, dict) else None
            if type(step) is not int or step < steps_in(found):
                shown = printable(line.decode(errors="replace").strip()[:60])
                return found, f"{where}: expected the record of step {steps_in(found)} or a later one, got {shown}"
            found.append(record)
    if len(line) > LARGEST_LINE:
        return found, f"{path}:{len(found) + 1}: a line of more than {LARGEST_LINE >> 20} MiB"
    return found, ""


# ---------------------------------------------------------------------- reading columns, to show them


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
class HistoryReader:
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
        self._reset()

    def read(self, to_the_end: bool = True) -> History:
        """What the file holds now.

        Args:
            to_the_end: also a last line without a line break. A run that goes on may be writing it: then leave it.

        Raises:
            InputError: the file is missing, too large, or a line of it is malformed; the file and the line are named.
        """
        with bounded_files.open_regular(self.path, self.folder) as file:
            status = os.fstat(file.fileno())
            if (status.st_dev, status.st_ino) != self._file or status.st_size < self._offset:
                self._reset()
                self._file = status.st_dev, status.st_ino
            if status.st_size > LARGEST:
                raise InputError(f"{self.path}: larger than {LARGEST >> 30} GiB, which no run writes")
            file.seek(self._offset)
            try:
                while data := file.read(_CHUNK):
                    self._offset += len(data)
                    self._add(data)
                if to_the_end and self._rest:
                    self._add(b"\n")
            except InputError:
                self._reset()  # so that the next call says the same, and does not go on behind the line
                raise
        return self._history()

    def _reset(self) -> None:
        self._columns = {name: [] for name in HISTORY_COLUMNS}
        self._errors = {}
        self._line, self._offset, self._rest, self._file = 0, 0, b"", (0, 0)

    def _add(self, data: bytes) -> None:
        *whole, self._rest = (self._rest + data).split(b"\n")
        for line in whole:
            self._line += 1
            self._add_record(line)
        if len(self._rest) > LARGEST_LINE:
            raise InputError(f"{self.path}:{self._line + 1}: a line of more than {LARGEST_LINE >> 20} MiB")

    def _add_record(self, line: bytes) -> None:
        if not line.strip():
            return
        where = f"{self.path}:{self._line}"
        if len(line) > LARGEST_LINE:
            raise InputError(f"{where}: a line of more than {LARGEST_LINE >> 20} MiB")
        try:
            record = bounded_files.parse_object(line.decode("utf-8-sig" if self._line == 1 else "utf-8"), where)
        except UnicodeDecodeError as error:
            raise InputError(f"{where}: not UTF-8 text ({error.reason} at byte {error.start})") from error
        found = {name: _number(record.get(name), f"{where}: {name}", name in HISTORY_AXES) for name in self._columns}
        for name in HISTORY_AXES:
            last = self._columns[name][-1] if self._columns[name] else 0.0
            if found[name] < last:
                raise InputError(f"{where}: {name}: expected no less than {last:g} before it, got {found[name]:g}")
        errors = record.get("parameter_error", {})
        if not isinstance(errors, dict):
            raise InputError(f"{where}: parameter_error: expected an object {{key: number}}, got {_short(errors)}")
        values = {
            key: _number(value, f"{where}: parameter_error.{printable(key)}", False) for key, value in errors.items()
        }
        for name, column in self._columns.items():
            column.append(found[name])
        for key, value in values.items():
            records, numbers = self._errors.setdefault(key, ([], []))
            records.append(len(self._columns["seconds"]) - 1)
            numbers.append(value if math.isfinite(value) else math.inf)

    def _history(self) -> History:
        return History(
            **{name: np.array(column, float) for name, column in self._columns.items()},
            parameter_error={
                key: ErrorHistory(np.array(r, int), np.array(v, float)) for key, (r, v) in self._errors.items()
            },
        )


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
    return printable(repr(value)) if value is not None else "nothing"
