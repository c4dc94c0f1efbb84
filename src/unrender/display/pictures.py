"""Arrays as PNG images embedded in a page."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np

from unrender.io.resampling import reduced
from unrender.losses.metrics import exposure, srgb


def quantized(colours: np.ndarray) -> np.ndarray:
    """Return display values as 8-bit numbers; values outside [0, 1] are clipped."""
    return (np.clip(colours, 0, 1) * 255 + 0.5).astype(np.uint8)


def png(picture: Any, effort: int = 6) -> bytes:
    """Encode values in [0, 1] or bytes, (H, W) or (H, W, 3 | 4), or an image of Pillow, as PNG. `effort` is the compression, 0 to 9."""
    from PIL import Image

    if isinstance(picture, np.ndarray):
        picture = Image.fromarray(picture if picture.dtype == np.uint8 else quantized(picture))
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", compress_level=effort)
    return buffer.getvalue()


def data_uri(colours: Any) -> str:
    """Return a picture that `png` encodes as the `src` of an HTML image."""
    return f"data:image/png;base64,{base64.b64encode(png(colours)).decode('ascii')}"


_LARGEST = 320  # limit of the sides of a picture in a notebook


def shown_image(linear: np.ndarray, like: np.ndarray | None = None) -> np.ndarray:
    """Convert linear RGB (H, W, 3) to sRGB in [0, 1] at the exposure of `like` (default: itself), with sides of at most 320."""
    factor = exposure(np.asarray(linear if like is None else like)[..., :3])
    with np.errstate(over="ignore", invalid="ignore"):
        return srgb(reduced(np.asarray(linear)[..., :3], _LARGEST) * factor)


def shown_map(values: np.ndarray, like: np.ndarray | None = None) -> np.ndarray | None:
    """Convert a texture, or the middle slice of a volume, to colours (H, W, 3) in [0, 1]; None for what `is_map` excludes.

    One channel is grey over the range of `like` (default: its own). Three or four channels are sRGB of the first three, divided by the
    maximum of `like` if that exceeds 1. Sides are at most 320.
    """
    picture = plane(np.asarray(values))
    if picture is None:
        return None
    scale = np.asarray(values if like is None else like)
    finite = scale[np.isfinite(scale)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    small = reduced(picture, _LARGEST)
    with np.errstate(over="ignore", invalid="ignore"):
        if picture.shape[-1] == 1:
            span = high - low if high > low else 1.0
            grey = np.clip(np.nan_to_num((small - low) / span), 0.0, 1.0)
            return np.repeat(grey, 3, axis=-1)
        return srgb(small[..., :3] * (1.0 if high <= 1 else 1 / high))


_VALUES_IN_A_TABLE = 16


def is_map(array: np.ndarray) -> bool:
    """Return whether a parameter is displayed as an image: textures (H, W), (H, W, 1 | 3 | 4), volumes (Z, Y, X, 1 | 3 | 4).

    At least two sides are longer than 1, and (H, W) has more than 16 elements.
    """
    if array.size == 0:
        return False
    if array.ndim == 2:
        return array.size > _VALUES_IN_A_TABLE and min(array.shape) > 1
    return array.ndim in (3, 4) and array.shape[-1] in (1, 3, 4) and sum(n > 1 for n in array.shape[:-1]) >= 2


def plane(array: np.ndarray) -> np.ndarray | None:
    """Return a texture, or the first middle slice of a volume, (H, W, C); None for other parameters."""
    return next(iter(planes(array).values()), None)


def planes(array: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return {label: (H, W, C)}: the texture itself, or the middle slices of a volume along its axes."""
    if array is None or not is_map(array):
        return {}
    if array.ndim == 2:
        return {"": array[..., None]}
    if array.ndim == 3:
        return {"": array}
    slices = {}
    for axis, name in enumerate("zyx"):
        plane = np.take(array, array.shape[axis] // 2, axis=axis)
        if min(plane.shape[:2]) > 1:
            slices[f"middle slice along {name}"] = plane
    return slices or {"slice": array.reshape(-1, *array.shape[2:])}
