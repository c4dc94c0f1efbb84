"""Small scenes with participating media, and how their parameters change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

SIZE = 16
DEPTH = 5
VOXELS = 6
LEVELS = {"empty": 0.0, "thin": 0.02, "middling": 1.0, "dense": 4.0}

_rng = np.random.default_rng(0)
KIND = _rng.permutation(np.arange(VOXELS**3) % 4).reshape(VOXELS, VOXELS, VOXELS, 1)
"""Which voxel has which of the `LEVELS`, in order; the dense ones are as dense as the majorant."""
DARK = _rng.permutation(np.arange(VOXELS**3) % 2).reshape(VOXELS, VOXELS, VOXELS, 1) == 0
"""Which voxels scatter nothing."""


def grid(values: np.ndarray, filter_type: str = "trilinear") -> dict[str, Any]:
    """A volume of (Z, Y, X, C) values over the cube [-1, 1]³."""
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    volume = mi.VolumeGrid(np.ascontiguousarray(values, dtype=np.float32))
    return {"type": "gridvolume", "grid": volume, "raw": True, "filter_type": filter_type, "to_world": place}


def density(channels: int = 1) -> np.ndarray:
    """Extinction at random, nothing outside a ball."""
    values = np.random.default_rng(3).uniform(0, 4, (8, 8, 8, channels))
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 8)] * 3, indexing="ij")
    values[x**2 + y**2 + z**2 > 1] = 0
    return values


def cloud(channels: int = 1, g: float = 0.3) -> dict[str, Any]:
    """A heterogeneous medium."""
    albedo = np.random.default_rng(1).uniform(0.3, 0.9, (8, 8, 8, 3))
    phase = {"type": "hg", "g": g}
    return {"type": "heterogeneous", "sigma_t": grid(density(channels)), "albedo": grid(albedo), "phase": phase}


def voxels() -> dict[str, Any]:
    """A heterogeneous medium of voxels that are empty, thin, middling, and at the majorant; half of them black."""
    albedo = np.where(DARK, 0, np.random.default_rng(1).uniform(0.3, 0.95, (*KIND.shape[:3], 3)))
    extinction = np.array(list(LEVELS.values()))[KIND]
    return {
        "type": "heterogeneous",
        "sigma_t": grid(extinction, "nearest"),
        "albedo": grid(albedo, "nearest"),
    }


def fog(
    extinction: tuple[float, float, float] = (0.5, 0.8, 1.2), phase: dict[str, Any] | None = None
) -> dict[str, Any]:
    """A homogeneous medium. Mitsuba takes colours of extinction up to 1 only, hence the scale."""
    return {
        "type": "homogeneous",
        "scale": 4.0,
        "sigma_t": {"type": "rgb", "value": [value / 4 for value in extinction]},
        "albedo": {"type": "rgb", "value": [0.9, 0.7, 0.5]},
        "phase": phase or {"type": "isotropic"},
    }


def scene(
    medium: dict[str, Any], boundary: str = "null", shape: str = "cube", lights: str = "lamp sky"
) -> dict[str, Any]:
    """A body of the medium above a floor; `lights` names those there are of lamp, sky, point."""
    to = mi.ScalarTransform4f
    sky = np.random.default_rng(5).uniform(0.1, 1.5, (8, 16, 3)).astype(np.float32)
    every = {
        "lamp": {
            "type": "rectangle",
            "to_world": to().look_at([1.5, -1, 3], [0, 0, 0], [0, 1, 0]) @ to().scale(0.6),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.0, 6.0]}},
        },
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        "point": {"type": "point", "position": [-2, -2, 2], "intensity": {"type": "rgb", "value": [5.0, 6.0, 7.0]}},
    }
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 35,
            "to_world": to().look_at([0, -5, 2.2], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
        },
        "body": {"type": shape, "bsdf": {"type": boundary}, "interior": medium},
        "floor": {
            "type": "rectangle",
            "to_world": to().translate([0, 0, -1.3]).scale(3),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.5, 0.3]}},
        },
        **{name: every[name] for name in lights.split()},
    }


def two_media() -> dict[str, Any]:
    """Voxels, a glass ball of fog before them, all lights, and a ball inside the voxels."""
    ball = {"type": "sphere", "center": [0, -1.9, 0.9], "radius": 0.5}
    stone = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}}
    return {
        **scene(voxels(), lights="lamp sky point"),
        "ball": {**ball, "bsdf": {"type": "dielectric"}, "interior": fog((0.8, 1.6, 2.4))},
        "stone": {"type": "sphere", "center": [0.2, 0.1, 0.3], "radius": 0.3, "bsdf": stone},
    }


def camera_inside() -> dict[str, Any]:
    """A room full of fog, the camera in it."""
    found = scene(fog((0.3, 0.3, 0.3)), shape="sphere")
    found["body"] = {"type": "sphere", "radius": 8, "bsdf": {"type": "null"}, "interior": {"type": "ref", "id": "air"}}
    found["sensor"]["medium"] = {"type": "ref", "id": "air"}
    return {
        "type": "scene",
        "air": {**fog((0.3, 0.3, 0.3)), "id": "air"},
        **{k: v for k, v in found.items() if k != "type"},
    }


SCENES: dict[str, Callable[[], dict[str, Any]]] = {
    "fog behind a null boundary": lambda: scene(fog((0.8, 0.8, 0.8))),
    "coloured fog": lambda: scene(fog()),
    "fog in glass": lambda: scene(fog(), "dielectric", "sphere"),
    "fog in rough glass": lambda: scene(fog(), "roughdielectric", "sphere"),
    "cloud": lambda: scene(cloud()),
    "coloured cloud, point light": lambda: scene(cloud(3), lights="point"),
    "cloud, all lights": lambda: scene(cloud(), lights="lamp sky point"),
    "voxels": lambda: scene(voxels()),
    "two media": two_media,
    "camera inside": camera_inside,
}


def media_keys(renderer: Any) -> list[str]:
    """The parameters of all media that have a gradient."""
    return [key for key, info in renderer.parameters().items() if "medium" in key and info.differentiable]
