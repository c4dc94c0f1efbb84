"""Photographs of one camera under known lights as a problem: a flat plate with a colour map and a normal map, seen from a distance.

A texel is a pixel. The plate fills the picture, faces the camera, and casts no shadow on itself. Where the object does, a photograph is
inconsistent with the others, to which the loss (L1) is robust.

The start is the least-squares solution of Woodham (1980). For an unshadowed pixel, a diffuse surface gives

    I_k = ρ n · l_k,   so that   ρ n = argmin Σ_k (I_k - g · l_k)²,

where l_k points towards light k, ρ is the reflectance times the light's intensity, and n is the normal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from scipy import ndimage

from unrender.app.capture import pictures, writing
from unrender.app.capture.cameras import Lens
from unrender.app.capture.formats.lights import LitCapture
from unrender.app.capture.views import Resampling, pinhole
from unrender.app.evaluation.scenes import HELD_OUT
from unrender.core.errors import InputError
from unrender.core.geometry import shortest_rotation
from unrender.io import images
from unrender.losses.metrics import srgb
from unrender.rendering.exposure import EXPOSURE

_SHADOW = 0.1  # fraction of a pixel's maximum brightness below which it may be in shadow
_WHITE = 0.97
_CLEARER = 0.9
"""Maximum ratio of the residuals of stored and of decoded values at which the stored values are treated as linear."""


@dataclass(frozen=True)
class LitViews:
    """Photographs at the chosen resolution.

    Attributes:
        values: (N, H, W, 3) float32, linear.
        directions: (N, 3) unit, towards the lights.
        mask: (H, W) in [0, 1], the fraction of a pixel that the object covers.
        held_out: whether each photograph is for evaluation only.
        linear: whether the values of 8- and 16-bit files are interpreted as linear.
    """

    names: tuple[str, ...]
    values: np.ndarray
    directions: np.ndarray
    mask: np.ndarray
    held_out: tuple[bool, ...]
    linear: bool

    @property
    def training(self) -> np.ndarray:
        """Indices of the photographs that are not held out."""
        return np.flatnonzero(~np.array(self.held_out))


def prepare(capture: LitCapture, resolution: int, scale: float | None, hold_out: int | None) -> LitViews:
    """Read all photographs, with at most `resolution` pixels along the longer side.

    Files of 8 or 16 bits are decoded as sRGB, or as linear if a diffuse surface fits their stored values clearly better.

    Args:
        capture: contents of the folder.
        resolution, scale: see `views.prepare`.
        hold_out: interval of lights that are held out, >= 2; 0 for none; None for 6. None are held out if fewer than four would remain.

    Raises:
        InputError: a photograph cannot be read, is turned by EXIF, has another size, or the mask is empty.
    """
    every = 6 if hold_out is None else hold_out
    if every == 1 or every < 0:
        raise InputError(f"--hold-out {every}: expected 0 for none, or at least 2")
    width, height, _ = pictures.upright(capture.photographs[0], None)
    lens = Lens(width, height, float(width), float(width), width / 2, height / 2)
    target = pinhole(lens, min(1.0, resolution / max(width, height)) if scale is None else scale)
    resample = Resampling(lens, target)
    resampled = []
    for path in capture.photographs:
        pictures.upright(path, None)
        read = pictures.read(path).values
        if read.shape[:2] != (height, width):
            has = f"{read.shape[1]} x {read.shape[0]} pixels, the first photograph {width} x {height}"
            raise InputError(f"{path}: {has}: expected one size for a static camera")
        resampled.append(resample.apply(read)[0])
    mask = np.ones(resampled[0].shape[:2], np.float32)
    if capture.mask is not None:
        picture = pictures.read_mask(capture.mask)
        if picture.shape != (height, width):
            raise InputError(
                f"{capture.mask}: {picture.shape[1]} x {picture.shape[0]} pixels, expected {width} x {height}"
            )
        mask = np.clip(resample.apply(picture[..., None])[0][..., 0], 0, 1)
        if not (mask > 0.999).any():
            raise InputError(f"{capture.mask}: empty (black); expected white on the object")
    count = len(resampled)
    held_out = tuple(bool(every and index % every == every // 2) for index in range(count))
    if count - sum(held_out) < 4:
        held_out = (False,) * count
    views = LitViews(
        tuple(path.name for path in capture.photographs), np.array(resampled), capture.directions, mask, held_out, False
    )
    if float(views.values.max()) > 1.001:  # not from files of 8 or 16 bits
        return views
    stored = replace(views, values=srgb(views.values).astype(np.float32), linear=True)
    return stored if _residual(stored) < _CLEARER * _residual(views) else views


def _residual(views: LitViews) -> float:
    """Return the relative root mean square residual of least squares over unshadowed, unsaturated pixels."""
    chosen = views.training
    values = views.values[chosen][:, views.mask > 0.999].mean(-1)
    clear = lit(values) & (values < _WHITE).all(0)
    if clear.sum() < 16:
        return np.inf
    values = values[:, clear]
    lights = views.directions[chosen]
    left = lights @ np.linalg.lstsq(lights, values, rcond=None)[0] - values
    return float(np.sqrt((left**2).mean() / (values**2).mean()))


def lit(values: np.ndarray) -> np.ndarray:
    """Return, for brightnesses (N, ...) under N lights, whether all are bright enough relative to the brightest to exclude shadows."""
    return (values > _SHADOW * values.max(0)).all(0) & (values.max(0) > 0)


def least_squares(values: np.ndarray, directions: Sequence[np.ndarray] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (..., 3) and reflectances (..., 3) per channel, for linear values (N, ..., 3) under N lights.

    Shadows are treated as dark colours. Normals come from the mean of the channels; those of black pixels face the camera.
    """
    lights = np.asarray(directions, float)
    flat = np.asarray(values, float).reshape(len(lights), -1, 3)
    scaled = np.linalg.lstsq(lights, flat.mean(2), rcond=None)[0].T
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    normal = np.where(length > 0, scaled / np.maximum(length, 1e-30), [0.0, 0.0, 1.0])
    shading = np.maximum(lights @ normal.T, 0)[..., None]
    colour = (flat * shading).sum(0) / np.maximum((shading**2).sum(0), 1e-12)
    return normal.reshape(*values.shape[1:-1], 3), colour.reshape(values.shape[1:])


NAMES = ("colour", "normal", "exposure")
"""Possible unknowns of such a problem."""
_COLOUR, _NORMAL = "base-colour.exr", "normal.exr"
OWN = frozenset({writing.PROBLEM, HELD_OUT, writing.SCENE, writing.REFERENCES, writing.MASKS, writing.TEXTURES})
"""Names that `write` creates in a folder."""
_KEYS = {
    "colour": "plate.bsdf.nested_bsdf.reflectance.data",
    "normal": "plate.bsdf.normalmap.data",
    "exposure": EXPOSURE,
}
_BRIGHTEST = 0.8  # reflectance of the 99th percentile of brightness
_DISTANCE = 100.0
"""Distance of the camera in half plate widths: nearly orthographic, with a sensor that recorded kernels support."""


def write(folder: Path, name: str, views: LitViews, chosen: Sequence[str]) -> None:
    """Write the problem of `chosen` unknowns, from `NAMES`, to an empty folder. Raises `InputError` if the mask covers no pixel completely,
    or an unknown is not supported."""
    if others := [one for one in chosen if one not in NAMES]:
        raise InputError(
            f"--unknowns {others[0]}: for one camera under known lights, expected some of {', '.join(NAMES)}"
        )
    for part in (writing.REFERENCES, writing.MASKS, writing.TEXTURES):
        (folder / part).mkdir()
    inside: np.ndarray = np.asarray(ndimage.binary_erosion(views.mask > 0.999, np.ones((3, 3)), border_value=1))
    if not inside.any():
        raise InputError(f"{name}: the mask covers no pixel completely; give a larger --resolution")
    chosen_views = views.training
    training_values: np.ndarray = views.values[chosen_views]
    _, colour = least_squares(training_values[:, inside], views.directions[chosen_views])
    strength = max(float(np.quantile(colour.max(1), 0.99)) / _BRIGHTEST, 1e-4)
    height, width = views.mask.shape
    images.write(
        np.full((height, width, 3), np.median(colour) / strength, np.float32), folder / writing.TEXTURES / _COLOUR
    )
    images.write(
        np.broadcast_to(np.array([0.5, 0.5, 1.0], np.float32), (height, width, 3)), folder / writing.TEXTURES / _NORMAL
    )
    (folder / writing.SCENE).write_bytes(_scene(views, strength))
    writing.write_mask(inside, folder / writing.MASKS / "mask.png")
    stems = writing.stems(views.names)
    for stem, values in zip(stems, views.values, strict=True):
        images.write(values, folder / writing.REFERENCES / f"{stem}.exr", half=True)
    turns = np.array([shortest_rotation((0, 0, 1), direction) for direction in views.directions])
    listed = writing.views(views.held_out, stems, ["mask"] * len(stems), writing.turned_light(turns))
    unknowns = [{"key": _KEYS[one], **({} if one == "exposure" else {"bounds": [0.0, 1.0]})} for one in chosen]
    writing.write_problems(folder, name, listed, unknowns, "L1", 2)


def _scene(views: LitViews, strength: float) -> bytes:
    """Return the scene under the first light. The camera looks along -z at a plate of width 2; each photograph has its own sensor."""
    root = Xml.Element("scene", version="3.0.0")
    height, width = views.mask.shape
    for stem in writing.stems(views.names):
        sensor = Xml.SubElement(root, "sensor", type="perspective", id=f"light-{stem}")
        writing.add_value(sensor, "string", "fov_axis", "x")
        writing.add_value(sensor, "float", "fov", 2 * math.degrees(math.atan(1 / _DISTANCE)))
        transform = Xml.SubElement(sensor, "transform", name="to_world")
        Xml.SubElement(transform, "lookat", origin=f"0, 0, {_DISTANCE:g}", target="0, 0, 0", up="0, 1, 0")
        writing.add_film(sensor, width, height)
    plate = Xml.SubElement(root, "shape", type="rectangle", id="plate")
    transform = Xml.SubElement(plate, "transform", name="to_world")
    Xml.SubElement(transform, "scale", x="1", y=repr(height / width), z="1")
    normal = Xml.SubElement(plate, "bsdf", type="normalmap")
    writing.add_value(normal, "boolean", "use_shadowing_function", "false")
    writing.add_texture(normal, "normalmap", _NORMAL, raw=True, pixels=True)
    writing.add_texture(Xml.SubElement(normal, "bsdf", type="diffuse"), "reflectance", _COLOUR, raw=True, pixels=True)
    light = Xml.SubElement(root, "emitter", type="directional", id="light")
    x, y, z = (repr(-float(number)) for number in views.directions[0])
    Xml.SubElement(light, "vector", name="direction", x=x, y=y, z=z)
    Xml.SubElement(light, "rgb", name="irradiance", value=repr(np.pi * strength))
    return writing.encoded(root)
