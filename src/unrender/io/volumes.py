"""Voxel grids in files: Mitsuba's `.vol`, NumPy's `.npy`, and `.npz` with one array.

A `.vol` file (little endian) contains "VOL", the version 3, the number type (1: float32, the only one that Mitsuba 3 reads), the sizes
along x, y and z, the number of channels, a box (minimum x, y, z, maximum x, y, z), and the numbers. Channels vary fastest, then x, y, z.
"""

from __future__ import annotations

import io
import math
import os
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from unrender.core import checks
from unrender.core.errors import InputError, prefixed
from unrender.core.text import in_words
from unrender.io import bounded_files, files

READABLE = (".vol", ".npy", ".npz")
"""File name extensions that `read_grid` supports."""

MOST_VALUES = 1 << 28
"""Largest number of values of a grid: one gigabyte in single precision."""

UNIT_BOX = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)

Shape = tuple[int, ...]

_MAGIC, _HEADER = b"VOL\3", struct.Struct("<4s5i6f")
_FLOAT = 1
_OTHERS = {2: "float16", 3: "uint8", 4: "quantised directions"}


@dataclass(frozen=True)
class Grid:
    """Voxels and their bounding box.

    Attributes:
        values: (Z, Y, X, C) float32, finite.
        box: minimum x, y, z, maximum x, y, z from a `.vol` file, which Mitsuba uses only if `use_grid_bbox` is set; the unit cube for
            NumPy files.
    """

    values: np.ndarray
    box: tuple[float, ...] = UNIT_BOX


def read_grid(path: str | Path, check: Callable[[Shape], None] | None = None) -> Grid:
    """Read the grid of a file.

    Arrays (Z, Y, X) are grids of one channel. Integers are not scaled: those of 8 or 16 bits above 1 are refused, as for parameters.

    Args:
        path: file of a kind in `READABLE`.
        check: function of the declared shape (Z, Y, X, C), called before memory is allocated; raises `InputError` for an unsuitable one.

    Raises:
        InputError: one line that begins with the file: it is missing or malformed, or the grid has an unsupported shape or type, is too
            large, or is not finite.
    """
    file = _existing(checks.path("read_grid", path, "a file"))

    def suits(shape: Shape) -> None:
        if len(shape) not in (3, 4) or 0 in shape:
            raise InputError(f"expected a grid of shape (Z, Y, X, C), got {shape}")
        _check_size(shape)
        if check is not None:
            check(shape if len(shape) == 4 else (*shape, 1))

    if file.suffix.lower() == ".vol":
        return _read_vol(file, suits)
    stored = read_numpy(file, suits)
    checks.refuse_encoded(stored, f"{file}: ", "")
    with np.errstate(over="ignore"):
        array = stored.astype(np.float32)
    _check_finite(file, array)
    return Grid(array if array.ndim == 4 else array[..., None])


def write_grid(path: str | Path, values: Any, box: Sequence[float] = UNIT_BOX) -> Path:
    """Write a grid atomically. Returns `path`.

    A `.vol` file that was read is written back bit for bit. `.vol` files contain float32.

    Args:
        path: file of a kind in `READABLE`, which determines the format.
        values: (Z, Y, X, C) or (Z, Y, X), or a `mitsuba.VolumeGrid`, which keeps its own box (`.vol` only).
        box: see `Grid`; NumPy files do not store it.

    Raises:
        InputError: the values or the box are invalid, or the file cannot be written.
    """
    file = checks.path("write_grid", path, "a file")
    ending = file.suffix.lower()
    if ending not in READABLE:
        raise InputError(f"{file}: unknown kind of grid, expected one of {', '.join(READABLE)}")
    if ending == ".vol" and type(values).__name__ == "VolumeGrid":
        import mitsuba as mi

        _check_finite(file, np.array(values))
        stream = mi.MemoryStream()
        values.write(stream)
        return files.write(file, stream.raw_buffer())
    checks.refuse_encoded(checks.as_array(values, f"{file}: "), f"{file}: ", "")
    try:
        array = np.ascontiguousarray(values, np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{file}: expected an array of numbers, got {in_words(values)}") from error
    array = array[..., None] if array.ndim == 3 else array
    if array.ndim != 4 or array.size == 0:
        raise InputError(f"{file}: expected a grid of shape (Z, Y, X, C), got {array.shape}")
    if len(box) != 6 or not all(math.isfinite(checks.real(side)) for side in box):
        raise InputError(f"{file}: box: expected six finite numbers, got {in_words(box)}")
    _check_finite(file, array)
    buffer = io.BytesIO()
    if ending == ".vol":
        z, y, x, channels = array.shape
        buffer.write(_HEADER.pack(_MAGIC, _FLOAT, x, y, z, channels, *box))
        buffer.write(array.astype("<f4", copy=False).tobytes())
    elif ending == ".npy":
        np.save(buffer, array, allow_pickle=False)
    else:
        save = np.savez_compressed if array.nbytes < files.COMPRESSED_BYTES // 2 else np.savez
        save(buffer, allow_pickle=False, grid=array)
    return files.write(file, buffer.getvalue())


def read_numpy(path: Path, check: Callable[[Shape], None] | None = None) -> np.ndarray:
    """Read the array of a `.npy` file, or the only one of an `.npz` archive: finite real numbers as stored. Raises `InputError`."""
    file = _existing(path)

    def named(shape: Shape) -> None:
        with prefixed(file):
            if check is not None:
                check(shape)

    if file.suffix.lower() == ".npz":
        (array,) = bounded_files.read_arrays(file, check=named, one=True).values()
    else:
        array = bounded_files.read_array(file, check=named)
    _check_finite(file, array)
    return array


def check_vol(path: Path) -> int:
    """Return the number of values of a `.vol` file. Raises `InputError` if it is malformed or its size differs from its header."""
    with bounded_files.open_regular(path) as file:
        shape, _ = _vol_header(file, path, _check_size)
    return math.prod(shape)


def _existing(file: Path) -> Path:
    if file.suffix.lower() not in READABLE:
        raise InputError(f"{file}: unknown kind of grid, expected one of {', '.join(READABLE)}")
    if bounded_files.kind(file) != "file":
        raise InputError(f"{file}: {bounded_files.no_file(file)}")
    return file


def _check_size(shape: Shape) -> None:
    if math.prod(shape) > MOST_VALUES:
        raise InputError(f"declares a grid of shape {shape}, expected at most {MOST_VALUES} values in all")


def _read_vol(path: Path, check: Callable[[Shape], None]) -> Grid:
    with files.input_errors(f"{path}: cannot be read"), bounded_files.open_regular(path) as file:
        shape, box = _vol_header(file, path, check)
        data = file.read(4 * math.prod(shape))
    if len(data) != 4 * math.prod(shape):
        raise InputError(f"{path}: it changed while it was read")
    values = np.frombuffer(data, "<f4").astype(np.float32).reshape(shape)
    _check_finite(path, values)
    return Grid(values, box)


def _vol_header(file: IO[bytes], path: Path, check: Callable[[Shape], None]) -> tuple[Shape, tuple[float, ...]]:
    """Return the shape (Z, Y, X, C) and the box; the file is then at its numbers. Raises `InputError`."""
    with prefixed(path):
        head = file.read(_HEADER.size)
        if head[:3] != _MAGIC[:3]:
            raise InputError("not a .vol file: it does not begin with VOL")
        if len(head) < _HEADER.size:
            raise InputError(f"cut short: {len(head)} bytes, its header alone has {_HEADER.size}")
        magic, kind, x, y, z, channels, *box = _HEADER.unpack(head)
        if magic != _MAGIC:
            raise InputError(f"expected version 3 of the format, got {magic[3]}")
        if kind != _FLOAT:
            raise InputError(f"expected float32 numbers, got {_OTHERS.get(kind, f'the unknown type {kind}')}")
        if min(x, y, z, channels) < 1:
            raise InputError(f"declares {x}x{y}x{z} voxels of {channels} channels, expected at least one of each")
        if not all(math.isfinite(side) for side in box):
            raise InputError("its box is not finite")
        shape = (z, y, x, channels)
        check(shape)
        actual, declared = os.fstat(file.fileno()).st_size - _HEADER.size, 4 * math.prod(shape)
        if actual != declared:
            raise InputError(f"its header declares {declared} bytes of numbers, there are {actual}")
    return shape, tuple(box)


def _check_finite(path: Path, values: np.ndarray) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        place = tuple(int(index) for index in np.argwhere(bad)[0])
        raise InputError(f"{path}: {int(bad.sum())} values are NaN or infinite, the first at index {place}")
