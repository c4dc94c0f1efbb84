"""Grids of voxels in files: Mitsuba's `.vol`, NumPy's `.npy`, and `.npz` with one array.

A `.vol` file (little endian): "VOL", the version 3, the type of its numbers (1: float32, the only one that Mitsuba 3 reads), sizes
along x, y and z, channels, a box (least x, y, z, greatest x, y, z), then the numbers: channels run fastest, then x, y, z.
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

from unrender.core.errors import InputError
from unrender.io import bounded_files, files

READABLE = (".vol", ".npy", ".npz")
"""File name endings that `read_grid` knows."""

MOST_VALUES = 1 << 28
"""Numbers of the largest grid that is read: one gigabyte in single precision."""

UNIT_BOX = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)

Shape = tuple[int, ...]

_MAGIC, _HEADER = b"VOL\3", struct.Struct("<4s5i6f")
_FLOAT = 1
_OTHERS = {2: "float16", 3: "uint8", 4: "quantised directions"}


@dataclass(frozen=True)
class Grid:
    """Voxels and the place that a file gives them.

    Attributes:
        values: (Z, Y, X, C) float32, finite.
        box: least x, y, z, greatest x, y, z: what `.vol` files tell, and Mitsuba goes by only where `use_grid_bbox` is set; the unit
            cube for NumPy's.
    """

    values: np.ndarray
    box: tuple[float, ...] = UNIT_BOX


def read_grid(path: str | Path, check: Callable[[Shape], None] | None = None) -> Grid:
    """The grid in a file.

    Arrays (Z, Y, X) count as grids of one channel; whole numbers are taken as they are.

    Args:
        path: one of `READABLE`.
        check: shown the shape (Z, Y, X, C) that the header declares, before memory is taken; raises `InputError` for one that does
            not suit.

    Raises:
        InputError: no such file, malformed, of another shape, too large, or not finite. One line, the file first.
    """
    file = _existing(Path(path))

    def suits(shape: Shape) -> None:
        if len(shape) not in (3, 4) or 0 in shape:
            raise InputError(f"expected a grid of shape (Z, Y, X, C), got {shape}")
        _check_size(shape)
        if check is not None:
            check(shape if len(shape) == 4 else (*shape, 1))

    if file.suffix.lower() == ".vol":
        return _read_vol(file, suits)
    array = read_numpy(file, suits)
    return Grid(array if array.ndim == 4 else array[..., None])


def write_grid(path: str | Path, values: Any, box: Sequence[float] = UNIT_BOX) -> Path:
    """Write a grid, beside its place first. Returns `path`.

    A `.vol` file that was read is written back bit for bit. Numbers of `.vol` files are float32.

    Args:
        path: one of `READABLE`, which says the format.
        values: (Z, Y, X, C) or (Z, Y, X), or a `mitsuba.VolumeGrid`, which keeps its own box (`.vol` only).
        box: see `Grid`; NumPy's files do not hold it.

    Raises:
        InputError: values or box are no such thing, or the file cannot be written.
    """
    file = Path(path)
    ending = file.suffix.lower()
    if ending not in READABLE:
        raise InputError(f"{file}: unknown kind of grid, expected one of {', '.join(READABLE)}")
    if ending == ".vol" and type(values).__name__ == "VolumeGrid":
        file.parent.mkdir(parents=True, exist_ok=True)
        values.write(str(file))
        return file
    array = np.ascontiguousarray(values, np.float32)
    array = array[..., None] if array.ndim == 3 else array
    if array.ndim != 4 or array.size == 0:
        raise InputError(f"{file}: expected a grid of shape (Z, Y, X, C), got {array.shape}")
    if len(box) != 6 or not all(math.isfinite(side) for side in box):
        raise InputError(f"{file}: box: expected six finite numbers, got {box!r}")
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
    """The array of a `.npy` file, or the only one of an `.npz` archive, as float32 of any shape. Raises `InputError`."""
    file = _existing(path)

    def named(shape: Shape) -> None:
        try:
            if check is not None:
                check(shape)
        except InputError as error:
            raise InputError(f"{file}: {error}") from error

    if file.suffix.lower() == ".npz":
        (array,) = bounded_files.read_arrays(file, check=named, one=True).values()
    else:
        array = bounded_files.read_array(file, check=named)
    with np.errstate(over="ignore"):
        array = array.astype(np.float32)
    _check_finite(file, array)
    return array


def check_vol(path: Path) -> int:
    """How many numbers a `.vol` file holds. Raises `InputError` where it is none, or does not hold what its header declares."""
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
    try:
        with bounded_files.open_regular(path) as file:
            shape, box = _vol_header(file, path, check)
            data = file.read(4 * math.prod(shape))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) != 4 * math.prod(shape):
        raise InputError(f"{path}: it changed while it was read")
    values = np.frombuffer(data, "<f4").astype(np.float32).reshape(shape)
    _check_finite(path, values)
    return Grid(values, box)


def _vol_header(file: IO[bytes], path: Path, check: Callable[[Shape], None]) -> tuple[Shape, tuple[float, ...]]:
    """Shape (Z, Y, X, C) and box; the numbers follow. Raises `InputError`."""
    try:
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
        there, declared = os.fstat(file.fileno()).st_size - _HEADER.size, 4 * math.prod(shape)
        if there != declared:
            raise InputError(f"its header declares {declared} bytes of numbers, there are {there}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return shape, tuple(box)


def _check_finite(path: Path, values: np.ndarray) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        place = tuple(int(index) for index in np.argwhere(bad)[0])
        raise InputError(f"{path}: {int(bad.sum())} values are NaN or infinite, the first at index {place}")
