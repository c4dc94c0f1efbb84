"""Reader of arrays in NumPy's format, which parses the header as text and checks sizes before it allocates memory."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import IO

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import printable

Shape = tuple[int, ...]

_AXES = 32
_BLOCK = 1 << 20
_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER = 1 << 12  # more than any type name and shape need
_INTEGER = rb"-?\d{1,40}L?"
_HEADER = re.compile(
    rb"\s*\{\s*'descr':\s*(?:'([^'\[\]]{1,16})'|\[[^\[\]]{0,1000}\]),\s*'fortran_order':\s*(True|False),"
    rb"\s*'shape':\s*\((\s*(?:" + _INTEGER + rb"(?:\s*,\s*" + _INTEGER + rb")*\s*,?)?\s*)\),?\s*\}\s*"
)


class MalformedHeader(ValueError):
    """Header of an array that does not describe plain numbers."""


def read_npy(file: IO[bytes], size: int, where: str, check: Callable[[Shape], None] | None, largest: int) -> np.ndarray:
    """Read an array in NumPy's format, of `size` bytes including its header. Raises `InputError` or `MalformedHeader`."""
    kind, columns_first, shape = _read_header(file, where)
    if any(side < 0 for side in shape) or len(shape) > _AXES:
        raise InputError(f"{where}: an array cannot have the shape {printable(str(shape))}")
    declared, actual = math.prod(shape) * kind.itemsize, size - file.tell()
    if declared > largest or declared != actual:
        raise InputError(f"{where}: declares the shape {printable(str(shape))}, {declared} bytes; {actual} follow")
    if check is not None:
        check(shape)
    data = bytearray(declared)
    for start in range(0, declared, _BLOCK):  # one read of an archive's member would need twice the memory
        block = file.read(min(_BLOCK, declared - start))
        data[start : start + len(block)] = block
        if len(block) < min(_BLOCK, declared - start):
            raise InputError(f"{where}: the array is cut short")
    if file.read(1):
        raise InputError(f"{where}: the array is cut short")
    return np.frombuffer(data, kind).reshape(shape, order="F" if columns_first else "C")


def _read_header(file: IO[bytes], where: str) -> tuple[np.dtype, bool, Shape]:
    """Return the real type, whether the order is column-major, and the shape. NumPy's own reader may be slow for a hostile header."""
    start = file.read(8)
    if start[:6] != _MAGIC or len(start) < 8:
        raise MalformedHeader
    if start[6:] not in (b"\1\0", b"\2\0"):
        raise InputError(f"{where}: not an .npy array of version 1 or 2")
    length = int.from_bytes(file.read(2 if start[6] == 1 else 4), "little")
    match = _HEADER.fullmatch(file.read(length)) if length <= _LONGEST_HEADER else None
    if match is None:
        raise MalformedHeader
    if match[1] is None:
        raise InputError(f"{where}: expected real numbers, got records")
    try:
        kind = np.dtype(match[1].decode("ascii"))
    except (TypeError, ValueError, SyntaxError) as error:
        raise MalformedHeader from error
    if kind.kind not in "fiub" or kind.hasobject:
        raise InputError(f"{where}: expected real numbers, got {printable(str(kind))}")
    shape = tuple(int(part) for part in match[3].replace(b"L", b"").split(b",") if part.strip())
    return kind, match[2] == b"True", shape
