"""Problem `camera`: poses of three cameras, from their images of a known scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, textures
from unrender.losses import L2, Loss
from unrender.scene.parameter import Parameter

_PLACES = {"left": (-1.95, 1.36, 1.95), "middle": (0.15, 1.89, 2.55), "right": (2.18, 1.06, 1.5)}
_TARGET = (0.0, 0.35, 0.0)
_TURN, _SHIFT = np.radians(2.0), 0.02
"""Initial error: an angle, and a distance relative to that of the target."""
_START = {
    "left": ((0.6, -0.5, 0.62), (-0.5, 0.8, 0.33)),
    "middle": ((-0.8, 0.3, 0.52), (0.4, 0.6, -0.69)),
    "right": ((0.1, 0.9, -0.42), (0.7, -0.1, 0.7)),
}
"""Directions of the rotation axis and of the shift."""


@register(name="camera", position=27)
@dataclass(frozen=True)
class Camera:
    """The poses of three cameras, from their images of a known scene.

    Three views. The unknowns are the translation and the rotation vector of each camera, (3,) each, 18 numbers. Initial errors are 2
    degrees and 2 % of the distance. The difficulty is that a rotation and a sideways shift have nearly the same effect: only the depth of
    the scene distinguishes them.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return objects of several heights on a patterned floor, before a patterned wall, under two suns."""
        floor = {"type": "diffuse", "reflectance": textures.bitmap(_pattern(3.0, 0.7))}
        wall = {"type": "diffuse", "reflectance": textures.bitmap(_pattern(4.0, 2.1))}
        return {
            "type": "scene",
            **{name: parts.camera(place, _TARGET, 54.0, self.resolution) for name, place in _PLACES.items()},
            "sun": parts.sun((0.5, 1.0, 0.6), 0.9),
            "fill": parts.sun((-0.7, 0.8, 0.5), 0.35),
            "floor": parts.rectangle((0, 0, 0), (3, 0, 0), (0, 0, -3), floor),
            "wall": parts.rectangle((0, 1.5, -1.6), (3, 0, 0), (0, 1.5, 0), wall),
            "tower": _block((-0.75, 0.6, -0.2), (0.2, 0.6, 0.2), 25.0, parts.diffuse(0.7, 0.25, 0.2)),
            "block": _block((0.65, 0.22, 0.5), (0.3, 0.22, 0.24), -35.0, parts.diffuse(0.25, 0.4, 0.7)),
            "ball": {
                "type": "sphere",
                "center": [0.0, 0.34, -0.1],
                "radius": 0.34,
                "bsdf": parts.diffuse(0.8, 0.75, 0.6),
            },
            "cone": meshes.sheet("cone", _cone(), parts.twosided(parts.diffuse(0.3, 0.65, 0.35)), closed=True),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return each camera rotated and shifted in a different direction."""
        unknowns = []
        for name, (shift, axis) in _START.items():
            distance = float(np.linalg.norm(np.subtract(_PLACES[name], _TARGET)))
            unknowns.append(Parameter(f"{name}.translation", initial=_SHIFT * distance * _unit(shift)))
            unknowns.append(Parameter(f"{name}.rotation", initial=_TURN * _unit(axis)))
        return tuple(unknowns)


def _unit(v: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(v) / np.linalg.norm(v)


def _pattern(frequency: float, phase: float) -> np.ndarray:
    """Return smooth stripes and spots of three colours, (64, 64, 3)."""
    x, y = textures.grid(64)
    first = 0.5 + 0.5 * np.sin(2 * np.pi * (frequency * x + 0.7 * np.sin(5 * y)) + phase)
    second = 0.5 + 0.5 * np.sin(2 * np.pi * frequency * 0.8 * y + 3 * x + phase)
    return (0.12 + 0.6 * np.stack([first, 0.5 * (first + second), second], -1)).astype(np.float32)


def _block(centre: tuple[float, ...], half: tuple[float, ...], angle: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate(list(centre)).rotate([0, 1, 0], angle).scale(list(half))
    return {"type": "cube", "to_world": place, "bsdf": bsdf}


def _cone() -> np.ndarray:
    t = np.linspace(0, 1, 24)
    return meshes.lathe(0.26 * (1 - t) + 1e-3, 0.8 * t, 48) + np.array([0.85, 0.0, -0.75])
