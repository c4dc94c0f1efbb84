"""history.jsonl: one line a step, on its way to the disk as soon as the step is done."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from unrender.io import files
from unrender.core.errors import InputError


class HistoryFile:
    """The file while the run goes. A line that could not be written is kept, and written with the next."""

    def __init__(self, path: Path):
        self.path = path
        self._file: int | None = None
        self._size = 0
        self._pending: list[bytes] = []

    def cut(self, records: Iterable[Mapping[str, Any]]) -> None:
        """Make the file say just these, and go on from there. Raises `OSError` or `InputError`."""
        self.close()
        self._pending = []
        text = lines(records)
        files.write(self.path, text)
        self._file = os.open(self.path, os.O_WRONLY | os.O_CLOEXEC)
        self._size = len(text)

    def append(self, record: Mapping[str, Any]) -> None:
        """Add one line. Raises `OSError`; the file then ends with the last whole line."""
        self._pending.append(lines([record]))
        if self._file is None:
            raise OSError("the file is closed")
        data = b"".join(self._pending)
        written = 0
        try:
            while written < len(data):
                written += os.pwrite(self._file, data[written:], self._size + written)
        except OSError:
            if written:
                os.ftruncate(self._file, self._size)
            raise
        self._size += len(data)
        self._pending = []

    def sync(self) -> None:
        """Have it on the disk before this returns. Raises `OSError`."""
        if self._file is not None:
            os.fsync(self._file)

    def close(self) -> None:
        """Harmless where it is closed."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def lines(records: Iterable[Mapping[str, Any]]) -> bytes:
    """The records as JSON, one a line; numbers that are not finite become null."""
    return "".join(json.dumps(_without_nan(record), allow_nan=False) + "\n" for record in records).encode()


def read(path: Path) -> tuple[list[dict[str, Any]], str]:
    """The records of a history up to the first line that is no record of its step, and what is wrong with that, "" where nothing is.

    A last line that was cut off is nothing wrong. Raises `InputError` where the file cannot be read.
    """
    found: list[dict[str, Any]] = []
    for line in files.read_text(path).splitlines(keepends=True):
        if not line.endswith("\n"):
            break
        where = f"{path}:{len(found) + 1}"
        try:
            record = files.parse_json(line, where)
        except InputError as error:
            return found, str(error)
        if not isinstance(record, dict) or type(record.get("step")) is not int or record["step"] != len(found):
            return found, f"{where}: expected the record of step {len(found)}, got {line.strip()[:60]}"
        found.append(record)
    return found, ""


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nan(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
