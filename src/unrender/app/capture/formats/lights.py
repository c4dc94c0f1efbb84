"""One camera, several distant lights: `lights.txt` and a photograph for each, the format of photometric stereo data sets.

The first line is the number of lights, followed by a line of three numbers for each, a direction towards the light: x right, y up, z
towards the camera. Photographs follow in the order of their names, with numbers compared by value (`cat.2` before `cat.10`). A picture
with "mask" in its name is the mask. The camera is assumed to be orthographic.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.app.capture.formats import files
from unrender.core.errors import InputError
from unrender.core.text import printable
from unrender.io import bounded_files, confinement

FILE = "lights.txt"
_LARGEST = 1 << 20
_FEWEST = 4  # minimum number of lights: three unknowns per pixel, and one equation to verify them


@dataclass(frozen=True)
class LitCapture:
    """At least four photographs of one camera, under one light each, with unit directions (N, 3) towards the lights: x right, y up, z
    towards the camera."""

    folder: Path
    photographs: tuple[Path, ...]
    directions: np.ndarray
    mask: Path | None


def recognise(folder: Path) -> bool:
    """Return whether a folder has such a file."""
    return (folder / FILE).is_file()


def read(folder: Path, mask: Path | None = None) -> LitCapture:
    """Read the capture of such a folder. `mask` is a folder with one mask, None for the folder itself. Raise `InputError`."""
    directions = _directions(folder / FILE)
    files.check_count(len(directions), folder / FILE)
    pictures = sorted(files.pictures(folder), key=_by_number)
    if not any("mask" not in path.name.lower() for path in pictures):
        pictures += sorted(files.pictures(folder / "images"), key=_by_number)
    photographs = tuple(path for path in pictures if "mask" not in path.name.lower())
    if len(photographs) != len(directions):
        many = f"{len(directions)} lights, and {len(photographs)} photographs"
        raise InputError(f"{folder / FILE}: {many}: they are matched in the order of names, so none may be missing")
    masks = files.pictures(mask) if mask is not None else [path for path in pictures if "mask" in path.name.lower()]
    if len(masks) > 1 or (mask is not None and not masks):
        place = folder if mask is None else mask
        raise InputError(f"{place}: expected one mask, since the camera is static, got {len(masks)}")
    for path in photographs:
        confinement.check(path, [folder], f"{folder}: it has the photograph")
    for path in masks:
        confinement.check(path, [folder if mask is None else mask], f"{folder}: it has the mask")
    return LitCapture(folder, photographs, directions, masks[0] if masks else None)


def _directions(path: Path) -> np.ndarray:
    lines = [line.split() for line in bounded_files.read_text(path, _LARGEST).splitlines() if line.strip()]
    expected = f"{path}: expected a count, then so many lines of three numbers, directions towards lights"
    try:
        if len(lines) < 2 or len(lines[0]) != 1 or int(lines[0][0]) != len(lines) - 1:
            raise InputError(expected)
        directions = np.array([[float(number) for number in line] for line in lines[1:]], float)
    except ValueError as error:
        raise InputError(f"{expected} ({printable(str(error)[:80])})") from error
    if directions.ndim != 2 or directions.shape[1] != 3 or not np.isfinite(directions).all():
        raise InputError(expected)
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    if not (length > 0).all():
        raise InputError(f"{expected}; one is 0 0 0")
    if len(directions) < _FEWEST:
        raise InputError(f"{path}: {len(directions)} lights, expected at least {_FEWEST}")
    if (directions[:, 2] <= 0).any():
        raise InputError(f"{path}: a light behind the object (z <= 0); expected z towards the camera")
    directions = directions / length
    if np.linalg.svd(directions)[1][2] < 0.05 * len(directions) ** 0.5:
        raise InputError(f"{path}: all lights lie in a plane, which leaves normals unknown")
    return directions


def _by_number(path: Path) -> list[tuple[int, int | str]]:
    """Return a sort key that compares numbers in a name by value."""
    parts = re.split(r"(\d{1,18})", path.name.lower())
    return [(0, int(part)) if index % 2 else (1, part) for index, part in enumerate(parts)]
