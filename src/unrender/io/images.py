"""Reading pictures: files and arrays become linear float32 arrays, or one clear line says why not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender.backend import variant
from unrender.core.errors import InputError
from unrender.core.text import reason_of
from unrender.io import bounded_files, image_size

READABLE = (".exr", ".hdr", ".rgbe", ".pfm", ".png", ".jpg", ".jpeg", ".bmp", ".tga", ".ppm", ".npy")
"""File name endings that `read` knows."""


@dataclass(frozen=True)
class Picture:
    """A picture in linear values.

    Attributes:
        values: (H, W, C) float32, C in {1, 3}.
        notice: one line on what was done to the values, "" if they were taken as they are.
        alpha: (H, W) float32 in [0, 1], of integer values that are not opaque everywhere, where it was asked for; else None.
    """

    values: np.ndarray
    notice: str = ""
    alpha: np.ndarray | None = None


def read(source: Any, linearise: bool = True, alpha: bool = False, channels: tuple[int, ...] = (1, 3, 4)) -> Picture:
    """The picture in a file or an array.

    Args:
        source: a file (`READABLE`), or an array (H, W), (H, W, 1), (H, W, 3) or (H, W, 4). The alpha of floating-point values is dropped.
            Floating-point values are linear; 8- and 16-bit integers are taken as sRGB in [0, 1].
        linearise: whether to undo the sRGB curve of 8- and 16-bit values; masks want them as they are.
        alpha: whether to keep the alpha of 8- and 16-bit values.
        channels: numbers of channels that arrays may have; of 2 the second is alpha.

    Raises:
        InputError: no such file, unreadable, of another shape, or not finite.
    """
    if isinstance(source, (str, Path)):
        path = Path(source)
        if bounded_files.kind(path) != "file":
            raise InputError(f"{path}: {bounded_files.no_file(path)}")
        if path.suffix.lower() not in READABLE:
            raise InputError(f"{path}: unknown kind of picture, expected one of {', '.join(READABLE)}")
        try:
            numpy_file = path.suffix.lower() == ".npy"
            if numpy_file:
                picture = _from_array(bounded_files.read_array(path), linearise, alpha, channels)
            else:
                picture = _read(path, linearise, alpha)
            _check_finite(picture.values)
        except InputError as error:
            raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
        return replace(picture, notice=f"{path.name}: {picture.notice}" if picture.notice else "")
    try:
        array = np.asarray(source)
    except (TypeError, ValueError) as error:
        raise InputError(f"expected a file or an array, got {type(source).__name__}") from error
    picture = _from_array(array, linearise, alpha, channels)
    _check_finite(picture.values)
    return picture


def resize(values: np.ndarray, height: int, width: int, around: bool = False) -> np.ndarray:
    """Return a picture (H, W, C) as (height, width, C): smoothed before it shrinks, linear between pixels where it grows.

    Args:
        values: the picture.
        height: of the result.
        width: of the result.
        around: whether its left and right borders are neighbours, as in an environment map.
    """
    if values.shape[:2] == (height, width):
        return values
    if around:
        return np.ascontiguousarray(resize(np.tile(values, (1, 3, 1)), height, 3 * width)[:, width : 2 * width])
    from skimage import transform

    scaled = transform.resize(values, (height, width, values.shape[2]), order=1, anti_aliasing=True, mode="edge")
    return np.asarray(scaled, np.float32)


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """The inverse of the sRGB transfer curve (IEC 61966-2-1), values in [0, 1]."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def luminance(values: np.ndarray) -> np.ndarray:
    """(..., 3) linear sRGB to (..., 1), by the weights of ITU-R BT.709."""
    return (values @ np.array([0.212671, 0.715160, 0.072169], np.float32))[..., None]


def xyz_to_rgb(values: np.ndarray) -> np.ndarray:
    """(..., 3) CIE XYZ to linear sRGB, by the matrix that Mitsuba has."""
    matrix = [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
    return values @ np.array(matrix, np.float32).T


def _read(path: Path, linearise: bool, alpha: bool) -> Picture:
    image_size.check(path)
    variant.ensure()
    import mitsuba as mi

    try:
        with variant.two_threads():
            bitmap = mi.Bitmap(str(path))
        if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
            return Picture(_colour_channels(bitmap))
        encoded = bool(bitmap.srgb_gamma())
        stored = np.array(bitmap)
        bits = 8 * stored.itemsize
        told = encoded and linearise
        transparent = told and bitmap.has_alpha() and (stored[..., -1] < np.iinfo(stored.dtype).max).any()
        single = bitmap.pixel_format() in (mi.Bitmap.PixelFormat.Y, mi.Bitmap.PixelFormat.YA)
        kind = mi.Bitmap.PixelFormat.Y if single else mi.Bitmap.PixelFormat.RGB
        if encoded and not linearise:
            bitmap.set_srgb_gamma(False)
        values = np.array(bitmap.convert(kind, mi.Struct.Type.Float32, False))
    except InputError:
        raise
    except Exception as error:  # Mitsuba throws what its image libraries throw
        raise InputError(f"cannot be read as a picture: {reason_of(error, 300)}") from error
    values = values.reshape(*values.shape[:2], -1)
    if not told:
        return Picture(values)
    coverage = _coverage(stored[..., -1]) if transparent and alpha else None
    told = f", its alpha {'left out' if coverage is None else 'taken as mask'}" if transparent else ""
    return Picture(values, f"{bits}-bit sRGB, linearised{told}", coverage)


def _coverage(stored: np.ndarray) -> np.ndarray:
    """Of integer alpha, in [0, 1]."""
    return (stored / np.float32(np.iinfo(stored.dtype).max)).astype(np.float32)


def _colour_channels(bitmap: Any) -> np.ndarray:
    """R, G and B of an EXR file of many channels, such as Mitsuba's own `aov` integrator writes: (H, W, 3)."""
    names = [field.name for field in bitmap.struct_()]
    if not {"R", "G", "B"} <= set(names):
        raise InputError(f"has the channels {', '.join(names)[:200]}, but not R, G and B")
    return np.array(bitmap)[..., [names.index(name) for name in "RGB"]].astype(np.float32)


def _from_array(array: np.ndarray, linearise: bool, alpha: bool, channels: tuple[int, ...]) -> Picture:
    if array.dtype == object or not (np.issubdtype(array.dtype, np.number) or array.dtype == bool):
        raise InputError(f"expected an array of numbers, got {array.dtype}")
    if np.iscomplexobj(array):
        raise InputError("expected an array of real numbers, got complex ones")
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in channels or 0 in array.shape:
        kind = "(H, W, 3)" if 3 in channels else "(H, W) or (H, W, 1)"
        raise InputError(f"expected an array of shape {kind}, got {array.shape}")
    values = array[..., : 1 if array.shape[2] == 2 else 3]
    if array.dtype in (np.uint8, np.uint16):
        bits = 8 * array.dtype.itemsize
        values = values.astype(np.float64) / (2**bits - 1)
        if not linearise:
            return Picture(values.astype(np.float32))
        transparent = array.shape[2] in (2, 4) and bool((array[..., -1] < 2**bits - 1).any())
        coverage = _coverage(array[..., -1]) if alpha and transparent else None
        told = ", its alpha taken as mask" if coverage is not None else ""
        return Picture(srgb_to_linear(values).astype(np.float32), f"{bits}-bit sRGB, linearised{told}", coverage)
    with np.errstate(over="ignore"):
        return Picture(np.ascontiguousarray(values, dtype=np.float32))


def _check_finite(values: np.ndarray) -> None:
    bad = ~np.isfinite(values).all(axis=-1)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise InputError(f"{int(bad.sum())} pixels are NaN or infinite, the first in row {row}, column {column}")
