"""Problem `glossy-room`: a metal tile and a gilded ball, recovered from the highlights and reflections of many small lights.

Under a large light, a rough surface resembles a smooth one. Roughness shows in the blur of reflections of small, bright objects. So the
room is dim and contains twelve small, tinted lights, and each texel is visible from several directions, in a few pixels each.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, textures
from unrender.losses import L2, Loss
from unrender.preconditioners import LargeSteps
from unrender.scene.parameter import Parameter

_LIGHTS = [
    # centre, normal
    *(((x, 2.99, z), (0, -1, 0)) for z in (0.3, 2.2) for x in (-1.2, 0.1, 1.3)),
    *(((-2.19, y, z), (1, 0, 0)) for y, z in ((1.9, 0.6), (0.9, 2.2))),
    *(((2.19, y, z), (-1, 0, 0)) for y, z in ((1.9, 0.6), (0.9, 2.2))),
    *(((x, y, 4.49), (0, 0, -1)) for x, y in ((-0.8, 2.6), (0.9, 2.4))),
]
_TINTS = [(35.0, 31.0, 28.0), (28.0, 31.0, 35.0), (35.0, 35.0, 35.0)]


@register(name="glossy-room", position=2)
@dataclass(frozen=True)
class GlossyRoom:
    """Base colour, roughness and metallic maps of a metal tile and a gilded ball, from their highlights.

    Several views. Four unknowns of texture_resolution² texels: base colour and roughness of the tile, metallic and roughness of the ball.
    """

    resolution: int = fields.resolution(128)
    texture_resolution: int = fields.texture_resolution(32)
    views: int = fields.integer(3, "cameras, side by side", at_least=1, at_most=16)
    reference_spp: int = fields.reference_spp(192)
    max_depth: int = fields.max_depth(5, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room: x in [-2.2, 2.2], y in [0, 3], z in [-1.5, 4.5], with cameras at z = 4 that look along -z."""
        wall = parts.diffuse(0.2)
        places = np.linspace(-1.5, 1.5, self.views) if self.views > 1 else [0.0]
        return {
            "type": "scene",
            **{
                f"camera_{number}": parts.camera((x, 1.5, 4.0), (0, 0.85, 0), 39.0, self.resolution)
                for number, x in enumerate(places)
            },
            "floor": parts.rectangle((0, 0, 1.5), (2.2, 0, 0), (0, 0, -3), parts.diffuse(0.25)),
            "ceiling": parts.rectangle((0, 3, 1.5), (2.2, 0, 0), (0, 0, 3), wall),
            "back": parts.rectangle((0, 1.5, -1.5), (2.2, 0, 0), (0, 1.5, 0), wall),
            "front": parts.rectangle((0, 1.5, 4.5), (-2.2, 0, 0), (0, 1.5, 0), wall),
            "left": parts.rectangle((-2.2, 1.5, 1.5), (0, 0, -3), (0, 1.5, 0), parts.diffuse(0.1, 0.25, 0.5)),
            "right": parts.rectangle((2.2, 1.5, 1.5), (0, 0, 3), (0, 1.5, 0), parts.diffuse(0.6, 0.3, 0.1)),
            **{f"light_{number}": _light(number) for number in range(len(_LIGHTS))},
            "tile": meshes.sheet("tile", _tile_points(33), _tile_material(self.texture_resolution)),
            "ball": {
                "type": "sphere",
                "to_world": _ball_frame((0.78, 0.64, 0.25), 0.64),
                "bsdf": _ball_material(self.texture_resolution),
            },
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the four maps, initially constant."""
        return (
            Parameter("tile.bsdf.base_color.data", initial=0.5),
            Parameter("tile.bsdf.roughness.data", initial=0.4, preconditioner=LargeSteps(2.0)),
            Parameter("ball.bsdf.metallic.data", initial=0.5),
            Parameter("ball.bsdf.roughness.data", initial=0.4, preconditioner=LargeSteps(2.0)),
        )


def _light(number: int) -> dict[str, Any]:
    centre, normal = _LIGHTS[number]
    right = np.array([0.0, 0.0, 1.0] if normal[0] else [1.0, 0.0, 0.0])
    up = np.cross(normal, right)
    emitter = parts.light(*_TINTS[number % len(_TINTS)])
    return parts.rectangle(centre, 0.17 * right, 0.17 * up, parts.diffuse(0.0), emitter=emitter)


def _tile_points(steps: int) -> np.ndarray:
    """Return a tile that leans back and bulges towards the cameras: points (steps, steps, 3)."""
    y, x = np.meshgrid(np.linspace(-1, 1, steps), np.linspace(-1, 1, steps), indexing="ij")
    bulge = 0.28 * (1 - x**2) * (1 - 0.6 * y**2)
    return np.stack([-0.7 + 0.7 * x, 0.95 + 0.9 * y, -0.45 - 0.25 * y + bulge], axis=-1)


def _ball_frame(centre: parts.Vector, radius: float) -> Any:
    """Return a sphere's frame with its pole at +y and the centre of its texture's first copy at +z."""
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90) @ mi.ScalarTransform4f().rotate([0, 0, 1], 180)
    return mi.ScalarTransform4f().translate(list(centre)) @ turn @ mi.ScalarTransform4f().scale(radius)


def _tile_material(resolution: int) -> dict[str, Any]:
    u, v = textures.grid(resolution)
    rings = 0.5 + 0.5 * np.cos(22 * np.hypot(u - 0.5, v - 0.5))
    return {
        "type": "principled",
        "metallic": 1.0,
        "base_color": textures.bitmap(textures.photograph("chelsea", resolution)),
        "roughness": textures.bitmap(0.2 + 0.4 * rings),
    }


def _ball_material(resolution: int) -> dict[str, Any]:
    u, v = textures.grid(resolution)
    dots = 1 - textures.ramp(np.hypot((4 * u) % 1 - 0.5, (3 * v) % 1 - 0.5), 0.25, 0.35)
    stripes = textures.ramp(np.sin(4 * np.pi * (u - v)), -0.5, 0.5)
    repeat = (2, 1.5)  # one copy on the side that the cameras see, ending a little below the equator
    return {
        "type": "principled",
        "base_color": parts.colour(0.85, 0.55, 0.2),
        "metallic": textures.bitmap(0.25 + 0.7 * dots, repeat),
        "roughness": textures.bitmap(0.2 + 0.4 * stripes, repeat),
    }
