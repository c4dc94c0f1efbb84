"""Checks of the files that objects of a scene refer to, before Mitsuba reads them: kind, size, and agreement with their header."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from unrender.core.errors import InputError
from unrender.core.text import shorten
from unrender.io import bounded_files, image_size, mesh_files, volumes

MOST_VALUES = 1 << 30
"""Largest number of values of all images and grids of a scene."""
_LARGEST = 1 << 32


@dataclass
class AssetChecks:
    """Checks of the files of one scene.

    Attributes:
        values: number of values of the images and grids so far.
    """

    values: int = 0

    def check(self, plugin: str, path: Path, index: int = 0) -> None:
        """Check a file that an object refers to, and add its values to `values`.

        Args:
            plugin: type of the object.
            index: `shape_index` of the object.

        Raises:
            InputError: one line that names the file.
        """
        if (kind := bounded_files.kind(path)) != "file":
            raise InputError(f"{shorten(str(path), 200)}: {_KINDS[kind]}")
        if plugin == "serialized":
            mesh_files.check_serialized(path, index)
        else:
            self.values += _CHECKS.get(plugin, _plain)(path) or 0
        if self.values > MOST_VALUES:
            raise InputError(f"{path}: with it the scene's pictures and grids have more than {MOST_VALUES} values")


_KINDS = {"": "no such file", "folder": "a folder, expected a file", "other": "not a regular file"}


def _picture(path: Path) -> int:
    try:
        return image_size.check(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _plain(path: Path) -> None:
    size = path.stat().st_size
    if size > _LARGEST:
        raise InputError(f"{path}: larger than {_LARGEST >> 30} GiB")


def _splats(path: Path) -> None:
    mesh_files.check_ply(path, splats=True)


_CHECKS: dict[str, Callable[[Path], int | None]] = {
    **dict.fromkeys(("bitmap", "envmap"), _picture),
    **dict.fromkeys(("gridvolume", "sdfgrid"), volumes.check_vol),
    **dict.fromkeys(("ellipsoids", "ellipsoidsmesh"), _splats),
    **dict.fromkeys(("measured", "measured_polarized"), lambda path: check_tensors(path)),
    "ply": mesh_files.check_ply,
    "obj": mesh_files.check_obj,
    "spectrum": lambda path: check_spectrum(path),
}


_MAGIC = b"tensor_file"
_MOST_FIELDS, _MOST_AXES = 1000, 16
_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 8, 8: 8, 9: 2, 10: 4, 11: 8}
"""Bytes per number of each type: integers of 8 to 64 bits, signed and unsigned; float16, float32, float64."""


def check_tensors(path: Path) -> None:
    """Raise `InputError` unless all tensors of a file are inside of it."""
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


_LARGEST_SPECTRUM = 1 << 20


def check_spectrum(path: Path) -> None:
    """Raise `InputError` unless the file is a spectrum: lines of a wavelength and a value."""
    text = bounded_files.read_text(path, _LARGEST_SPECTRUM)
    for number, line in enumerate(text.split("\n"), 1):
        words = line.partition("#")[0].split()
        try:
            if len(words) not in (0, 2):
                raise ValueError
            for word in words:
                float(word)
        except ValueError as error:
            raise InputError(f"{path}:{number}: expected a wavelength and a value") from error
