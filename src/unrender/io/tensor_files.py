"""Files of named tensors, Mitsuba's format for measured materials, checked before Mitsuba maps them into memory."""

from __future__ import annotations

import math
import os
import struct
from pathlib import Path
from typing import IO

from unrender.core.errors import InputError
from unrender.io import bounded_files

__all__ = ["check"]

_MAGIC = b"tensor_file"
_MOST_FIELDS, _MOST_AXES = 1000, 16
_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 8, 8: 8, 9: 2, 10: 4, 11: 8}
"""Of each type of number: whole ones of 8 to 64 bits, with and without sign; float16, float32, float64."""


def check(path: Path) -> None:
    """Raise `InputError` unless all tensors of a file lie within it."""
    try:
        with bounded_files.open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if file.read(12).rstrip(b"\0") != _MAGIC:
                raise ValueError("no tensor file")
            _, fields = _read(file, "<HI")
            if fields > _MOST_FIELDS:
                raise ValueError("too many tensors")
            for _ in range(fields):
                _check_field(file, size)
    except (struct.error, ValueError, KeyError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a tensor file that can be read ({error})") from error


def _check_field(file: IO[bytes], size: int) -> None:
    (length,) = _read(file, "<H")
    file.read(length)
    axes, kind, offset = _read(file, "<HBQ")
    if axes > _MOST_AXES:
        raise ValueError("too many axes")
    shape = _read(file, f"<{axes}Q")
    if offset + math.prod(shape) * _BYTES[kind] > size:
        raise ValueError("a tensor that leads out of the file")


def _read(file: IO[bytes], form: str) -> tuple[int, ...]:
    return struct.unpack(form, file.read(struct.calcsize(form)))
