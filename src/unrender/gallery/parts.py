"""Shared parts of gallery scenes, as Mitsuba dictionaries: camera, surfaces, lights, textures; and unknown coordinates of poses."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.io.images import srgb_to_linear
from unrender.rendering.mitsuba.film_response import is_spectral
from unrender.scene.parameter import Parameter

Vector = Sequence[float] | np.ndarray


def camera(origin: Vector, target: Vector, fov: float, resolution: int) -> dict[str, Any]:
    """Return a pinhole camera, y upwards, with a full angle in degrees and a square film with a box filter, so that pixels share no
    samples."""
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(list(map(float, origin)), list(map(float, target)), [0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": resolution,
            "height": resolution,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }


def cameras_around(
    angles: Sequence[float] | np.ndarray,
    distance: float,
    heights: Sequence[float],
    target: Vector,
    fov: float,
    resolution: int,
) -> dict[str, Any]:
    """Return cameras "camera_0", "camera_1", ... around the y axis, at angles in radians from +z towards +x, and at `heights` in turn."""
    places = [(distance * np.sin(a), heights[n % len(heights)], distance * np.cos(a)) for n, a in enumerate(angles)]
    return {f"camera_{n}": camera(place, target, fov, resolution) for n, place in enumerate(places)}


def rectangle(centre: Vector, right: Vector, up: Vector, bsdf: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return a rectangle that faces `right` × `up`, perpendicular vectors from the centre to the midpoints of two edges. A texture is
    upright when viewed from its front."""
    x, y = np.asarray(right, float), np.asarray(up, float)
    normal = np.cross(x, y)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = x, y, normal / np.linalg.norm(normal)
    matrix[:3, 3] = centre
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix.tolist()), "bsdf": bsdf, **more}


def sphere(centre: Vector, radius: float, bsdf: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return a sphere."""
    return {"type": "sphere", "center": [float(x) for x in centre], "radius": radius, "bsdf": bsdf, **more}


def unit(vector: Vector) -> np.ndarray:
    """Return a vector of length 1."""
    return np.asarray(vector) / np.linalg.norm(vector)


def facing(direction: Vector) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors to the right and upwards of a `rectangle` that faces this direction, of any length; y is up."""
    normal = unit(direction)
    right = unit(np.cross([0.0, 1.0, 0.0], normal))
    return right, np.cross(normal, right)


def colour(*rgb: float) -> dict[str, Any]:
    """Return a colour in linear RGB; one number is grey."""
    return {"type": "rgb", "value": list(rgb) if len(rgb) == 3 else [rgb[0]] * 3}


def diffuse(*rgb: float) -> dict[str, Any]:
    """Return a one-sided diffuse material with this RGB reflectance; one number is grey."""
    return {"type": "diffuse", "reflectance": colour(*rgb)}


def twosided(bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return the material on both sides."""
    return {"type": "twosided", "bsdf": bsdf}


def light(*rgb: float) -> dict[str, Any]:
    """Return an area light with this RGB radiance; one number is grey."""
    return {"type": "area", "radiance": colour(*rgb)}


def room(walls: dict[str, Any], left: dict[str, Any], right: dict[str, Any]) -> dict[str, Any]:
    """Return a closed room, x and y in [-1, 1], z in [-1, 2.2], with walls that face inward. `walls` is the material of back, front,
    floor and ceiling."""
    return {
        "back": rectangle((0, 0, -1), (1, 0, 0), (0, 1, 0), walls),
        "left": rectangle((-1, 0, 0.6), (0, 0, -1.6), (0, 1, 0), left),
        "right": rectangle((1, 0, 0.6), (0, 0, 1.6), (0, 1, 0), right),
        "front": rectangle((0, 0, 2.2), (-1, 0, 0), (0, 1, 0), walls),
        "floor": rectangle((0, -1, 0.6), (1, 0, 0), (0, 0, -1.6), walls),
        "ceiling": rectangle((0, 1, 0.6), (1, 0, 0), (0, 0, 1.6), walls),
    }


def uplight(place: Vector, radiance: Sequence[float], name: str = "lamp") -> dict[str, Any]:
    """Return a lamp that lights the ceiling: a small square light at the bottom of a wide box that is open at the top.

    Light leaves over the edge of the box. It reaches a ceiling 2 above it within 2 (half + opening) / height - half = 0.94 of the lamp's
    axis, so no wall farther away is lit directly. The sides are visible from outside only; inside they are black.

    Args:
        place: centre of the light.
        radiance: RGB.
        name: prefix of the parts' names.
    """
    x, y, z = (float(v) for v in place)
    half, opening, height = 0.03, 0.115, 0.3
    metal = diffuse(0.4)
    pieces = {
        f"{name}_light": rectangle((x, y, z), (half, 0, 0), (0, 0, -half), diffuse(0.0), emitter=light(*radiance))
    }
    for side, (dx, dz) in {"left": (-1, 0), "right": (1, 0), "near": (0, 1), "far": (0, -1)}.items():
        pieces[f"{name}_shade_{side}"] = rectangle(
            (x + opening * dx, y + height / 2, z + opening * dz),
            (opening * dz, 0, -opening * dx),
            (0, height / 2, 0),
            metal,
        )
    return pieces


CLEAR = ((0.12, 0.25, 0.6), (0.65, 0.7, 0.75), (0.2, 0.18, 0.15))
"""Radiance of zenith, horizon, and below the horizon: noon over bare ground."""


def picture(
    sun: Vector, radius: float, radiance: Vector, colours: Sequence[Vector] = CLEAR, rows: int = 128
) -> np.ndarray:
    """Return a sky with a sun: (rows, 2 rows, 3) float32 radiance, with the zenith in its first row.

    Args:
        sun: unit direction to the sun.
        radius: angular radius of the sun in radians; a texel belongs to it if its centre does.
        radiance: RGB of the sun.
        colours: RGB radiance of zenith, horizon, and below the horizon.
    """
    columns = 2 * rows
    theta = np.pi * (np.arange(rows)[:, None] + 0.5) / rows
    phi = 2 * np.pi * (np.arange(columns)[None, :] + 0.5) / columns
    # Mitsuba's convention: u = atan2(x, -z) / 2 pi, v = acos(y) / pi.
    direction = np.stack(
        np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)), -1
    )
    height = direction[..., 1:2]
    zenith, horizon, below = (np.asarray(colour, float) for colour in colours)
    sky = horizon + (zenith - horizon) * np.clip(height, 0, 1) ** 0.5
    sky = np.where(height < 0, below, sky)
    within = np.arccos(np.clip(direction @ np.asarray(sun, float), -1, 1)) < radius
    return np.where(within[..., None], np.asarray(radiance, float), sky).astype(np.float32)


def environment(values: np.ndarray) -> dict[str, Any]:
    """Return an environment map, with the y axis upwards, as a Mitsuba dictionary."""
    return {"type": "envmap", "bitmap": mi.Bitmap(values), "to_world": mi.ScalarTransform4f()}


def sun(towards: Vector, *rgb: float) -> dict[str, Any]:
    """Return light from one direction, towards the light; `rgb` is the radiance of a white surface that faces it, one number for grey."""
    direction = -np.asarray(towards, float)
    irradiance = [np.pi * value for value in rgb]
    return {"type": "directional", "direction": direction.tolist(), "irradiance": colour(*irradiance)}


def unknown_pose(
    shape: str, part: str, start: dict[str, float], bounds: tuple[float, float] | None = None
) -> list[Parameter]:
    """Return the coordinates {"x" | "y" | "z": initial value} of the "translation" or "rotation" of a shape or light, 0 in the true
    scene."""
    return [Parameter(f"{shape}.{part}.{axis}", initial=value, bounds=bounds) for axis, value in start.items()]


Photograph = Literal["astronaut", "chelsea", "coffee", "rocket", "brick", "gravel", "grass"]
"""Photographs in scikit-image's wheel, which need no download."""

DARKEST, BRIGHTEST = 0.04, 0.9
"""Range of reflectances of real paints."""


def photograph(name: Photograph, resolution: int) -> np.ndarray:
    """Return the central square of a photograph as reflectance: float32 (resolution, resolution, 3), linear, in [0.04, 0.9]."""
    return _photograph(name, resolution).copy()


@lru_cache(maxsize=16)  # a problem makes its scene several times
def _photograph(name: Photograph, resolution: int) -> np.ndarray:
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
    """Resample (side, side, 3) linearly, with smoothing before a reduction, as `skimage.transform.resize` does. Importing SciPy's filters
    would take a fifth of a second."""
    side = len(picture)
    factor = side / resolution
    texels = np.arange(side)
    weights = np.eye(side)
    if factor > 1:
        deviation = (factor - 1) / 2
        offsets = np.arange(-int(4 * deviation + 0.5), int(4 * deviation + 0.5) + 1)
        gaussian = np.exp(-((offsets / deviation) ** 2) / 2)
        weights = np.zeros((side, side))
        for offset, weight in zip(offsets, gaussian / gaussian.sum(), strict=True):
            weights[texels, _mirrored(texels + offset, side)] += weight
    at = (np.arange(resolution) + 0.5) * factor - 0.5
    below = np.floor(at).astype(int)
    above = (at - below)[:, None]
    rows = (1 - above) * weights[_mirrored(below, side)] + above * weights[_mirrored(below + 1, side)]
    small = np.einsum("ij,jkc,lk->ilc", rows, picture, rows, optimize=True)
    return np.clip(small, picture.min(), picture.max())


def _mirrored(index: np.ndarray, side: int) -> np.ndarray:
    """Return the texel that each index shows where the picture is mirrored at the centres of its outermost texels."""
    index = np.abs(index) % (2 * side - 2)
    return np.minimum(index, 2 * side - 2 - index)


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
    """Return a differentiable texture of values (H, W, C) or (H, W), whose first row is at the top (v = 1).

    With `repeat` copies in u and in v, it is at v = 0, and every other copy is mirrored, so that there are no seams."""
    pixels = np.ascontiguousarray(values if values.ndim == 3 else values[..., None], dtype=np.float32)
    if repeat is None:
        wrap, to_uv = "clamp", mi.ScalarTransform4f().translate([0, 1, 0]) @ mi.ScalarTransform4f().scale([1, -1, 1])
    else:
        wrap, to_uv = "mirror", mi.ScalarTransform4f().scale([*repeat, 1])
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": not is_spectral(), "wrap_mode": wrap, "to_uv": to_uv}
