"""history.jsonl: one line per step, written as soon as the step is done; with readers for finished and growing files.

A run of millions of steps thins its earlier lines (`thinned`), so that the file can be read in seconds.
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
"""Largest line in bytes."""
LARGEST = 1 << 30
"""Largest file in bytes."""
THINNED_FROM = 1 << 26
"""Size in bytes from which a run's earlier steps are thinned."""
_CHUNK = 1 << 20
_REFINEMENTS = frozenset({"resolution", "faces"})  # fields of the records that are never removed


# ---------------------------------------------------------------------- records


def steps_in(records: Sequence[Mapping[str, Any]]) -> int:
    """Return the number of steps of a history, including those whose records were removed."""
    return max(int(records[-1].get("step", 0)) + 1, len(records)) if records else 0


def thinned(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Remove about every second record of the earlier three quarters.

    Records remain if their step is a multiple of twice the current stride, or if they record a change of resolution or of a mesh. A
    history that is thinned repeatedly stays evenly spaced, by powers of two.
    """
    early = len(records) - len(records) // 4
    if early < 2:
        return list(records)
    stride = 1
    while all(
        record["step"] % (2 * stride) == 0 for record in records[: early // 2] if _REFINEMENTS.isdisjoint(record)
    ):
        stride *= 2
        if stride > records[-1]["step"]:
            return list(records)
    remaining = [r for r in records[:early] if r["step"] % (2 * stride) == 0 or not _REFINEMENTS.isdisjoint(r)]
    return [*remaining, *records[early:]]


# ---------------------------------------------------------------------- writing


class HistoryFile:
    """The file during a run. A line that cannot be written is buffered, and written with the next."""

    def __init__(self, path: Path):
        self.path = path
        self._file: int | None = None
        self._pending: list[bytes] = []
        self.size = 0
        """Size of the file in bytes."""

    def rewrite(self, records: Iterable[Mapping[str, Any]], name_too: bool = True) -> None:
        """Replace the contents by these records, and append after them; see `files.write`. If it raises, the file is unchanged."""
        text = lines(records)
        files.write(self.path, text, name_too=name_too)
        opened = os.open(self.path, os.O_WRONLY | os.O_CLOEXEC)
        self.close()
        self._file, self.size, self._pending = opened, len(text), []

    def append(self, record: Mapping[str, Any]) -> None:
        """Append one line. Raises `OSError`; the file then ends with the last complete line."""
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
        """Flush the file to the disk. Raises `OSError`."""
        if self._file is not None:
            files.flush(self._file)

    def close(self) -> None:
        """Close the file. Does nothing if it is closed."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def lines(records: Iterable[Mapping[str, Any]]) -> bytes:
    """Return the records as JSON, one per line; numbers that are not finite become null, and what JSON cannot store its `repr`."""
    return "".join(json.dumps(_storable(record), allow_nan=False, default=repr) + "\n" for record in records).encode()


def _storable(value: Any) -> Any:
    value = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value  # a callback's
    if isinstance(value, Mapping):
        return {str(key): _storable(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_storable(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


# ---------------------------------------------------------------------- reading records, to go on from them


def read_records(path: Path, folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Return the records up to the first invalid line, and the fault of that line, "" for none.

    A line is invalid if it is not the record of a later step. A truncated last line is not a fault. Raises `InputError` if the file
    cannot be read or is larger than `LARGEST`.
    """
    records: list[dict[str, Any]] = []
    with bounded_files.open_regular(path, folder) as file:
        if os.fstat(file.fileno()).st_size > LARGEST:
            raise InputError(f"{path}: larger than {LARGEST >> 30} GiB, which no run writes")
        while (line := file.readline(LARGEST_LINE + 1)).endswith(b"\n"):
            where = f"{path}:{len(records) + 1}"
            try:
                record = bounded_files.parse_json(line.removeprefix(codecs.BOM_UTF8 if not records else b""), where)
            except InputError as error:
                return records, str(error)
            step = record.get("step") if isinstance(record, dict) else None
            if type(step) is not int or step < steps_in(records):
                shown = printable(line.decode(errors="replace").strip()[:60])
                return records, f"{where}: expected the record of step {steps_in(records)} or a later one, got {shown}"
            records.append(record)
    if len(line) > LARGEST_LINE:
        return records, f"{path}:{len(records) + 1}: a line of more than {LARGEST_LINE >> 20} MiB"
    return records, ""


# ---------------------------------------------------------------------- reading columns, to show them


@dataclass(frozen=True)
class ErrorHistory:
    """One parameter's recorded error, infinite where a record has no number, and the ascending indices of these records in the history."""

    records: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class History:
    """history.jsonl as columns of equal length.

    Attributes:
        seconds, samples: totals since the start, ascending.
        loss, gradient_noise: NaN if the record has no number.
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
    """Reader of a history in a run folder that may still grow. A file that was replaced or truncated is read from the start."""

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
        """Return the current contents, `to_the_end` with an unfinished last line. Raises `InputError` that names file and line."""
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
                self._reset()  # the next call must report the same error, and not continue after the line
                raise
        return self._history()

    def _reset(self) -> None:
        self._columns = {name: [] for name in HISTORY_COLUMNS}
        self._errors = {}
        self._line, self._offset, self._rest, self._file = 0, 0, b"", (0, 0)

    def _add(self, data: bytes) -> None:
        *complete, self._rest = (self._rest + data).split(b"\n")
        for line in complete:
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
        numbers_by_name = {
            name: _number(record.get(name), f"{where}: {name}", name in HISTORY_AXES) for name in self._columns
        }
        for name in HISTORY_AXES:
            last = self._columns[name][-1] if self._columns[name] else 0.0
            if numbers_by_name[name] < last:
                raise InputError(
                    f"{where}: {name}: expected no less than {last:g} before it, got {numbers_by_name[name]:g}"
                )
        errors = record.get("parameter_error", {})
        if not isinstance(errors, dict):
            raise InputError(f"{where}: parameter_error: expected an object {{key: number}}, got {_short(errors)}")
        values = {
            key: _number(value, f"{where}: parameter_error.{printable(key)}", False) for key, value in errors.items()
        }
        for name, column in self._columns.items():
            column.append(numbers_by_name[name])
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
        number = float(value)
    except OverflowError:
        number = math.inf
    if required and not math.isfinite(number):
        raise InputError(f"{where}: expected a finite number, got {_short(value)}")
    return number if math.isfinite(number) else math.nan


def _short(value: Any) -> str:
    return printable(repr(value)) if value is not None else "nothing"
