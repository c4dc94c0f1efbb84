"""Problems `camera` and `stage-lights`: poses of three cameras and of three lights, from images of a known scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.scene.parameter import Parameter

_PLACES = {"left": (-1.95, 1.36, 1.95), "middle": (0.15, 1.89, 2.55), "right": (2.18, 1.06, 1.5)}
_TARGET = (0.0, 0.35, 0.0)
_TURN, _SHIFT = np.radians(2.0), 0.02  # initial error: an angle, and a distance relative to that of the target
_START = {
    "left": ((0.6, -0.5, 0.62), (-0.5, 0.8, 0.33)),
    "middle": ((-0.8, 0.3, 0.52), (0.4, 0.6, -0.69)),
    "right": ((0.1, 0.9, -0.42), (0.7, -0.1, 0.7)),
}
"""Directions of the rotation axis and of the shift."""


@register(name="camera", position=27)
@dataclass(frozen=True)
class Camera(fields.Rendered):
    """The poses of three cameras, from their images of a known scene.

    Three views. The unknowns are the translation and the rotation vector of each camera, (3,) each, 18 numbers. Initial errors are 2
    degrees and 2 % of the distance. The difficulty is that a rotation and a sideways shift have nearly the same effect: only the depth of
    the scene distinguishes them.
    """

    def scene(self) -> dict[str, Any]:
        """Return objects of several heights on a patterned floor, before a patterned wall, under two suns."""
        floor = {"type": "diffuse", "reflectance": parts.bitmap(_pattern(3.0, 0.7))}
        wall = {"type": "diffuse", "reflectance": parts.bitmap(_pattern(4.0, 2.1))}
        return {
            "type": "scene",
            **{name: parts.camera(place, _TARGET, 54.0, self.resolution) for name, place in _PLACES.items()},
            "sun": parts.sun((0.5, 1.0, 0.6), 0.9),
            "fill": parts.sun((-0.7, 0.8, 0.5), 0.35),
            "floor": parts.rectangle((0, 0, 0), (3, 0, 0), (0, 0, -3), floor),
            "wall": parts.rectangle((0, 1.5, -1.6), (3, 0, 0), (0, 1.5, 0), wall),
            "tower": _block((-0.75, 0.6, -0.2), (0.2, 0.6, 0.2), 25.0, parts.diffuse(0.7, 0.25, 0.2)),
            "block": _block((0.65, 0.22, 0.5), (0.3, 0.22, 0.24), -35.0, parts.diffuse(0.25, 0.4, 0.7)),
            "ball": parts.sphere([0.0, 0.34, -0.1], 0.34, parts.diffuse(0.8, 0.75, 0.6)),
            "cone": meshes.sheet("cone", _cone(), parts.twosided(parts.diffuse(0.3, 0.65, 0.35)), closed=True),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return each camera rotated and shifted in a different direction."""
        unknowns = []
        for name, (shift, axis) in _START.items():
            distance = float(np.linalg.norm(np.subtract(_PLACES[name], _TARGET)))
            unknowns.append(Parameter(f"{name}.translation", initial=_SHIFT * distance * parts.unit(shift)))
            unknowns.append(Parameter(f"{name}.rotation", initial=_TURN * parts.unit(axis)))
        return tuple(unknowns)


def _pattern(frequency: float, phase: float) -> np.ndarray:
    """Return smooth stripes and spots of three colours, (64, 64, 3)."""
    x, y = parts.grid(64)
    first = 0.5 + 0.5 * np.sin(2 * np.pi * (frequency * x + 0.7 * np.sin(5 * y)) + phase)
    second = 0.5 + 0.5 * np.sin(2 * np.pi * frequency * 0.8 * y + 3 * x + phase)
    return (0.12 + 0.6 * np.stack([first, 0.5 * (first + second), second], -1)).astype(np.float32)


def _block(centre: tuple[float, ...], half: tuple[float, ...], angle: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate(list(centre)).rotate([0, 1, 0], angle).scale(list(half))
    return {"type": "cube", "to_world": place, "bsdf": bsdf}


def _cone() -> np.ndarray:
    t = np.linspace(0, 1, 24)
    return meshes.lathe(0.26 * (1 - t) + 1e-3, 0.8 * t, 48) + np.array([0.85, 0.0, -0.75])


_LIGHTS: dict[str, tuple[str, dict[str, float]]] = {
    "spot": ("rotation", {"x": 0.15, "z": -0.12}),
    "softbox": ("translation", {"x": -0.4, "y": 0.3, "z": 0.2}),
    "beamer": ("rotation", {"x": 0.05, "y": 0.05}),
}


@register(name="stage-lights", position=33)
@dataclass(frozen=True)
class StageLights(fields.Rendered):
    """The direction of a spotlight, the position of a softbox and the rotation of a projector, from one image of a stage.

    One view. Seven unknowns: two angles of the spotlight, whose rotation about its own axis has no effect, the softbox's translation, and
    two angles of the projector. None of the lights is visible itself.
    """

    max_depth: int = fields.max_depth(3, at_least=2)

    def scene(self) -> dict[str, Any]:
        """Return the stage: x in [-2, 2], z in [-1.5, 2], a backdrop at z = -1.5, two blocks, and the camera at its front, looking along
        -z."""
        place = mi.ScalarTransform4f
        picture = parts.bitmap(parts.photograph("coffee", 8))
        return {
            "type": "scene",
            "camera": parts.camera((0, 1.6, 5.0), (0, 0.6, -0.5), 42.0, self.resolution),
            "floor": parts.rectangle((0, 0, 0.25), (2, 0, 0), (0, 0, -1.75), parts.diffuse(0.6, 0.5, 0.4)),
            "backdrop": parts.rectangle((0, 1.25, -1.5), (2, 0, 0), (0, 1.25, 0), parts.diffuse(0.7)),
            "block": {
                "type": "cube",
                "to_world": place().translate([-0.7, 0.3, -0.2]).rotate([0, 1, 0], 30).scale(0.3),
                "bsdf": parts.diffuse(0.3, 0.4, 0.6),
            },
            "pillar": {
                "type": "cube",
                "to_world": place().translate([0.8, 0.5, 0.1]).scale([0.15, 0.5, 0.15]),
                "bsdf": parts.diffuse(0.6, 0.3, 0.3),
            },
            "spot": {
                "type": "spot",
                "to_world": place().look_at([0, 4, 2.5], [-0.6, 0, 0], [1, 0, 0]),
                "intensity": parts.colour(22.0, 16.0, 9.0),
                "cutoff_angle": 20.0,
            },
            "softbox": {
                "type": "rectangle",
                "to_world": place().translate([0.9, 2.4, 1.0]).rotate([1, 0, 0], 90).scale(0.35),
                "bsdf": parts.diffuse(0.0),
                "emitter": parts.light(9.0, 11.0, 14.0),
            },
            "beamer": {
                "type": "projector",
                "to_world": place().look_at([0, 1.5, 3.5], [0.3, 1.4, -1.5], [0, 1, 0]),
                "irradiance": picture,
                "fov": 28.0,
                "scale": 12.0,
            },
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the lights' poses, initially a rough guess."""
        unknowns: list[Parameter] = []
        for light, (part, start) in _LIGHTS.items():
            unknowns += parts.unknown_pose(light, part, start)
        return tuple(unknowns)
