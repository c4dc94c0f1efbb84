"""Conversion of an initial or true value to an array of the parameter's shape: a number, a colour, an image, a grid or an array.

Files are converted as Mitsuba converts a file of the scene. The scene's own file therefore has error 0.

| parameter | file | conversion |
|---|---|---|
| `data` of a `bitmap` | picture | 8 and 16 bits: sRGB, or linear if the texture has `raw`; row 0 at the top |
| `data` of an `envmap` | picture of H × W | linearised; each end gets a copy of the opposite column: H × (W + 2) |
| `data` of a `gridvolume` | `.vol` | none |
| `vertex_positions`, `vertex_normals`, `vertex_texcoords`, attributes | `.obj`, `.ply`, `.serialized` | see below |
| any | `.npy`, `.npz` | none; the parameter's shape |

Values of a texture in half precision are rounded. Meshes are loaded with the settings of the shape. They need the same vertices in the
same order, with Mitsuba's duplicates at seams. A picture or grid of another resolution is resized, with a note. A colour picture fills a
one-channel texture by its luminance, a grey one all channels. A notice tells of an EXIF orientation, another gamma or another profile,
which Mitsuba ignores.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays, checks, periodic
from unrender.core.errors import InputError, prefixed
from unrender.core.text import in_words
from unrender.io import bounded_files, images, resampling, volumes

MESH_FILES = (".obj", ".ply", ".serialized")
"""File name extensions of meshes."""


@dataclass(frozen=True)
class FileConversion:
    """Conversion that the renderer applies to this parameter when it loads it from a file of the scene.

    Attributes:
        raw: whether 8- and 16-bit images are linear; otherwise they are sRGB.
        half: whether the renderer stores values in half precision.
        repeated: number of columns at each end of the second axis that repeat those of the opposite end; Mitsuba's environment maps have
            one. The parameter has the shape (H, W + 2 `repeated`, C), and its images have (H, W).
        takes_number: whether one number can fill the values, as it cannot for positions, directions and texture coordinates.
        vertices: function that returns the parameter's values from a mesh file as a flat float32 array; None for other parameters.
    """

    raw: bool = False
    half: bool = False
    repeated: int = 0
    takes_number: bool = True
    vertices: Callable[[Path], np.ndarray] | None = field(default=None, compare=False, repr=False)

    def picture_shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape (H, W, C) of an image that fills a parameter of this shape without scaling."""
        return periodic.interior_shape(shape, self.repeated)

    def stored(self, values: np.ndarray) -> np.ndarray:
        """Return float32 values rounded to the renderer's precision. Values beyond the range of half precision are not changed."""
        if not self.half:
            return values
        with np.errstate(over="ignore"):
            rounded = values.astype(np.float16).astype(np.float32)
        return np.where(np.isfinite(rounded), rounded, values)


PLAIN = FileConversion()
"""Conversion that stores values unchanged."""


def fill(initial: Any, shape: tuple[int, ...], conversion: FileConversion = PLAIN) -> tuple[np.ndarray, str]:
    """Return `initial` as float32 of `shape`, and a notice about its conversion, "" for none.

    A number fills any shape, a colour the last axis. An image file fills (H, W, C), and a .vol file (Z, Y, X, C); other resolutions are
    resized. A mesh file fills values at vertices. An array, a .npy file, or an .npz archive of one array must have the shape; a last axis
    of length 1 may be missing. A shape of one axis, such as that of vertices (n V,), also accepts (V, n) with V >= n or V = 1. Images and
    arrays may omit repeated border columns. Values of arrays are linear and not rescaled.

    Args:
        initial: the value as passed.
        conversion: the renderer's conversion of such a file in a scene.

    Raises:
        InputError: the value does not fit, cannot be read, is not finite, or has integers of 8 or 16 bits above 1.
    """
    if isinstance(initial, (str, Path)):
        path = Path(initial)
        if not path.suffix and not bounded_files.kind(path):  # a word, such as "rough"
            raise InputError(f"{path}: no such file; expected a number, a colour, or a picture or grid file")
        values, notice = _from_file(path, shape, conversion)
        return periodic.repeat(conversion.stored(values), conversion.repeated), notice
    initial = checks.array_like(initial, "fill it")
    try:
        array = arrays.to_numpy(initial, shape)
        if array.dtype == bool or not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
            raise TypeError
    except (TypeError, ValueError) as error:
        raise InputError(
            f"expected a number, a colour, a picture or grid file or an array, got {in_words(initial)}"
        ) from error
    checks.refuse_encoded(array)
    with np.errstate(over="ignore"):
        array = conversion.stored(array.astype(np.float32))
    if not np.isfinite(array).all():
        raise InputError("must be finite, got NaN or infinite values")
    if array.size > 3 and not conversion.takes_number and not np.ptp(array):
        raise InputError(f"expected different values, got {array.flat[0]:g} for all")
    if array.shape == shape:
        return periodic.repeat(array, conversion.repeated), ""
    if array.shape == conversion.picture_shape(shape):
        return periodic.pad(array, conversion.repeated), ""
    if _is_unflattened(array.shape, shape):
        return array.reshape(shape), ""
    scalar = array.shape in ((), (1,)) and (conversion.takes_number or not shape)
    colour = array.ndim == 1 and len(shape) > 1 and array.shape[0] == shape[-1]
    if scalar or colour:
        return np.array(np.broadcast_to(array.reshape(-1) if colour else array.reshape(()), shape)), ""
    got = f"an array of shape {array.shape}" if array.size != 1 else f"the number {array.item():g}"
    raise InputError(f"expected {_expected(shape, conversion)}, got {got}")


def at_one_point(positions: np.ndarray) -> bool:
    """Return whether the positions (n V,) of several vertices are all equal."""
    return positions.size > 3 and not np.ptp(positions.reshape(-1, 3), axis=0).any()


def _from_file(path: Path, shape: tuple[int, ...], conversion: FileConversion) -> tuple[np.ndarray, str]:
    ending = path.suffix.lower()
    if ending == ".vol":
        return _from_grid(path, shape)
    if ending in MESH_FILES:
        return _from_mesh(path, shape, conversion), ""
    if ending in (".npy", ".npz"):
        array = volumes.read_numpy(path, lambda size: _check_shape(size, shape, conversion))
        with prefixed(path):
            return fill(array.astype(np.uint8) if array.dtype == bool else array, shape, conversion)
    picture = images.read(path, not conversion.raw)
    if len(shape) != 3:
        raise InputError(f"{path}: a picture cannot fill a parameter of shape {shape}, expected {_expected(shape)}")
    height, width, channels = conversion.picture_shape(shape)
    values, remarks = picture.values, [picture.notice.partition(": ")[2]] if picture.notice else []
    faults, profile = images.metadata(path, bool(picture.notice))
    remarks += [*faults, profile] if profile and picture.notice else faults
    if channels == 1 and values.shape[2] == 3:
        values = images.luminance(values)
        remarks.append("reduced to its luminance")
    elif channels in (3, 4) and values.shape[2] == 1:
        values = np.repeat(values, 3, axis=2)
    if channels == 4:
        values = np.concatenate([values, np.ones_like(values[..., :1])], axis=2)
    if values.shape[2] != channels:
        raise InputError(f"{path}: a picture cannot fill a parameter of {channels} channels")
    if values.shape[:2] != (height, width):
        remarks.append(f"scaled from {values.shape[1]}x{values.shape[0]} to {width}x{height}")
        values = images.resize(values, height, width, around=conversion.repeated > 0)
    values = periodic.pad(np.ascontiguousarray(values, np.float32), conversion.repeated)
    return values, f"{path.name}: {', '.join(remarks)}" if remarks else ""


def _from_mesh(path: Path, shape: tuple[int, ...], conversion: FileConversion) -> np.ndarray:
    if conversion.vertices is None:
        raise InputError(f"{path}: a mesh file cannot fill this parameter, expected {_expected(shape)}")
    values = conversion.vertices(path)
    if values.shape != shape:
        numbers = f"{values.size} numbers at its vertices, and the scene's mesh has {shape[0]}"
        raise InputError(f"{path}: has {numbers}; give a mesh of as many vertices, in the same order")
    return values


def _from_grid(path: Path, shape: tuple[int, ...]) -> tuple[np.ndarray, str]:
    def check(grid_shape: tuple[int, ...]) -> None:
        if len(shape) != 4:
            raise InputError(f"a grid cannot fill a parameter of shape {shape}, expected {_expected(shape)}")
        if grid_shape[-1] != shape[-1]:
            raise InputError(f"a grid of {grid_shape[-1]} channels cannot fill a parameter of {shape[-1]}")

    grid = volumes.read_grid(path, check).values
    if grid.shape == shape:
        return grid, ""
    sizes = ["x".join(map(str, reversed(size[:-1]))) for size in (grid.shape, shape)]
    return resampling.resize(grid, shape[:-1]), f"{path.name}: scaled from {sizes[0]} to {sizes[1]} voxels"


def _check_shape(array_shape: tuple[int, ...], shape: tuple[int, ...], conversion: FileConversion) -> None:
    number = array_shape in ((), (1,)) and conversion.takes_number
    colour = len(array_shape) == 1 and len(shape) > 1 and array_shape[0] == shape[-1]
    same = array_shape in (shape, conversion.picture_shape(shape)) or _is_unflattened(array_shape, shape)
    if not (number or colour or same):
        raise InputError(f"expected {_expected(shape, conversion)}, got an array of shape {array_shape}")


def _is_unflattened(array_shape: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Return whether an array lacks a last axis of length 1, or is (V, n) for (n V,), unless 1 < V < n: it is likely (n, V) then."""
    if len(shape) == 1 and len(array_shape) == 2:
        rows, columns = array_shape
        return rows * columns == shape[0] and (rows >= columns or rows == 1)
    return shape[-1:] == (1,) and array_shape == shape[:-1]


def _expected(shape: tuple[int, ...], conversion: FileConversion = PLAIN) -> str:
    if not shape:
        return "a number"
    accepted = ["a number"] if conversion.takes_number else []
    if shape == (3,):
        return " or ".join([*accepted, "3 numbers"])
    accepted += ["a colour (3 numbers)"] if len(shape) > 1 and shape[-1] == 3 else []
    accepted += ["a mesh file"] if conversion.vertices is not None else []
    comma = "," if len(accepted) > 1 or conversion.takes_number else ""
    return f"{', '.join(accepted)}{comma} or an array of shape {conversion.picture_shape(shape)}"
