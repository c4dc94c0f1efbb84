"""Images as textures: photographs from scikit-image's installation, and procedural patterns.

Textures are float32, linear, and stored unchanged, because Mitsuba does not differentiate 8-bit bitmaps. They are `raw` in RGB variants;
spectral variants upsample colours, and cannot use raw ones.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.io.images import srgb_to_linear
from unrender.rendering.mitsuba.film_response import is_spectral

Photograph = Literal["astronaut", "chelsea", "coffee", "rocket", "brick", "gravel", "grass"]
"""Photographs in scikit-image's wheel, which need no download."""

DARKEST, BRIGHTEST = 0.04, 0.9
"""Range of reflectances of real paints."""


def photograph(name: Photograph, resolution: int) -> np.ndarray:
    """Return the central square of a photograph as reflectance: float32 (resolution, resolution, 3), linear, in [0.04, 0.9]."""
    picture = _read(name)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    height, width = picture.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    linear = srgb_to_linear(picture[top : top + side, left : left + side, :3] / 255.0)
    small = _resized(linear, resolution)
    return np.clip(DARKEST + (BRIGHTEST - DARKEST) * small, DARKEST, BRIGHTEST).astype(np.float32)


def _read(name: Photograph) -> np.ndarray:
    """Return the photograph from its file. Importing scikit-image would take a second."""
    from PIL import Image

    package = find_spec("skimage")
    if package is None or not package.submodule_search_locations:
        raise InputError(
            "gallery: scikit-image is not installed, whose photographs are needed: pip install scikit-image"
        )
    path = Path(package.submodule_search_locations[0]) / "data" / f"{name}.{'jpg' if name == 'rocket' else 'png'}"
    with Image.open(path, formats=["PNG", "JPEG"]) as image:
        return np.asarray(image)


def _resized(picture: np.ndarray, resolution: int) -> np.ndarray:
    """Resample (side, side, 3) linearly, with smoothing before a reduction, as `skimage.transform.resize` does."""
    from scipy import ndimage

    factor = picture.shape[0] / resolution
    blurred = picture
    if factor > 1:
        blurred = ndimage.gaussian_filter(picture, ((factor - 1) / 2, (factor - 1) / 2, 0), mode="mirror")
    small = ndimage.zoom(blurred, (1 / factor, 1 / factor, 1), order=1, mode="mirror", grid_mode=True)
    return np.clip(np.asarray(small), picture.min(), picture.max())


def grid(resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Return texture coordinates (u, v) of texel centres: two arrays (resolution, resolution) in (0, 1), u along columns."""
    centres = (np.arange(resolution) + 0.5) / resolution
    u, v = np.meshgrid(centres, centres)
    return u, v


def ramp(x: np.ndarray, low: float | np.ndarray, high: float | np.ndarray) -> np.ndarray:
    """Return a smooth step of `x` from 0 at `low` to 1 at `high`."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def mix(low: np.ndarray, high: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return colours between `low` (at 0) and `high` (at 1), (3,) or (H, W, 3), by the share of each texel, (H, W)."""
    return low + (high - low) * share[..., None]


def bitmap(values: np.ndarray, repeat: tuple[float, float] | None = None) -> dict[str, Any]:
    """Return a differentiable texture of values (H, W, C) or (H, W) as a Mitsuba dictionary.

    Args:
        values: the first row is at the top (v = 1), or at v = 0 with `repeat`.
        repeat: number of copies in u and v from 0 to 1; every other copy is mirrored, so that there are no seams.
    """
    pixels = np.ascontiguousarray(values if values.ndim == 3 else values[..., None], dtype=np.float32)
    if repeat is None:
        wrap, to_uv = "clamp", mi.ScalarTransform4f().translate([0, 1, 0]) @ mi.ScalarTransform4f().scale([1, -1, 1])
    else:
        wrap, to_uv = "mirror", mi.ScalarTransform4f().scale([*repeat, 1])
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": not is_spectral(), "wrap_mode": wrap, "to_uv": to_uv}
