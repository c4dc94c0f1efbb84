"""Problems `glossy-room`, `chalice`, `mirror-trio` and `spiral`: roughness and metalness, from highlights and reflections.

Under a large light, a rough surface resembles a smooth one. Roughness shows in the blur of reflections of small, bright objects. So
`glossy-room` is dim and contains twelve small, tinted lights, and each texel is visible from several directions, in a few pixels each.

`chalice` is after Balint et al. 2023, Fig. 9, a hard case for finite differences. A small light samples the edge of the lobe. A small
change of roughness moves this edge across several pixels, so the relative change of a sample is large, and roughness also affects the
sampling. Differences of gradients are then as noisy as gradients.

`mirror-trio` is the variance experiment of adaptive pixel sampling (Fig. 3 of its paper). One number is unknown, and only pixels of the
mirror contain information about it, most of all the edges of reflections and the blurred reflections of lamps.

`spiral` is after Balint et al. 2023, Fig. 1. Colour, metalness and roughness are correlated: from one side, a darker metal and a rougher
dielectric look alike. Two shaded lamps light the ribbon via the ceiling and the upper walls, and it reflects itself: every sample is noisy.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.losses import Loss, RelativeL2
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
class GlossyRoom(fields.Rendered):
    """Base colour, roughness and metallic maps of a metal tile and a gilded ball, from their highlights.

    Several views. Four unknowns of texture_resolution² texels: base colour and roughness of the tile, metallic and roughness of the ball.
    """

    resolution: int = fields.resolution(128)
    texture_resolution: int = fields.texture_resolution(32)
    views: int = fields.integer(3, "cameras, side by side", at_least=1, at_most=16)
    reference_spp: int = fields.reference_spp(192)
    max_depth: int = fields.max_depth(5, at_least=2)

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
    u, v = parts.grid(resolution)
    rings = 0.5 + 0.5 * np.cos(22 * np.hypot(u - 0.5, v - 0.5))
    return {
        "type": "principled",
        "metallic": 1.0,
        "base_color": parts.bitmap(parts.photograph("chelsea", resolution)),
        "roughness": parts.bitmap(0.2 + 0.4 * rings),
    }


def _ball_material(resolution: int) -> dict[str, Any]:
    u, v = parts.grid(resolution)
    dots = 1 - parts.ramp(np.hypot((4 * u) % 1 - 0.5, (3 * v) % 1 - 0.5), 0.25, 0.35)
    stripes = parts.ramp(np.sin(4 * np.pi * (u - v)), -0.5, 0.5)
    repeat = (2, 1.5)  # one copy on the side that the cameras see, ending a little below the equator
    return {
        "type": "principled",
        "base_color": parts.colour(0.85, 0.55, 0.2),
        "metallic": parts.bitmap(0.25 + 0.7 * dots, repeat),
        "roughness": parts.bitmap(0.2 + 0.4 * stripes, repeat),
    }


_LAMPS = ((-1.4, 2.6, 1.6), (1.5, 2.2, 1.2), (0.2, 2.9, 2.2), (-1.9, 1.2, 0.4), (2.0, 1.0, 0.2), (0.0, 2.4, -1.2))


@register(name="chalice", position=7)
@dataclass(frozen=True)
class Chalice(fields.Rendered):
    """The roughness map of a metal chalice under small, bright lights.

    Two views. One unknown, the roughness (texture_resolution², 1), initially constant, with LargeSteps.
    """

    resolution: int = fields.resolution(96)
    texture_resolution: int = fields.texture_resolution(64)
    max_depth: int = fields.max_depth(4, at_least=2)
    loss: Loss = field(default=RelativeL2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the chalice, 1.5 high, on a table y = 0 around the y axis, with six lamps of the size of a coin above and around it."""
        return {
            "type": "scene",
            "camera_0": parts.camera((0.0, 1.5, 3.6), (0, 0.75, 0), 30.0, self.resolution),
            "camera_1": parts.camera((2.9, 1.3, 2.1), (0, 0.75, 0), 30.0, self.resolution),
            "sky": {"type": "constant", "radiance": parts.colour(0.03)},
            "table": parts.rectangle((0, 0, 0), (4, 0, 0), (0, 0, -4), parts.diffuse(0.25, 0.2, 0.16)),
            "chalice": meshes.sheet(
                "chalice", meshes.lathe(*_chalice_profile(160), 160), _silver(self.texture_resolution), closed=True
            ),
            **{
                f"lamp_{number}": _lamp(place, (0, 0.75, 0), 0.04, (500.0, 470.0, 420.0))
                for number, place in enumerate(_LAMPS)
            },
        }

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("chalice.bsdf.brdf_0.roughness.data", initial=0.65, preconditioner=LargeSteps(2.0)),)


def _lamp(place: parts.Vector, target: parts.Vector, half: float, radiance: parts.Vector) -> dict[str, Any]:
    """Return a square light of half the side `half` that faces a point."""
    right, up = parts.facing(np.subtract(target, place))
    return parts.rectangle(place, half * right, half * up, parts.diffuse(0.0), emitter=parts.light(*radiance))


def _chalice_profile(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radius and height of foot, stem with a knot, and bowl."""
    from scipy.interpolate import PchipInterpolator

    height = np.linspace(0, 1, rows)
    knots = [
        (0, 0.42),
        (0.03, 0.42),
        (0.08, 0.2),
        (0.18, 0.09),
        (0.26, 0.15),
        (0.34, 0.08),
        (0.46, 0.2),
        (0.62, 0.44),
        (1, 0.52),
    ]
    return PchipInterpolator(*np.array(knots).T)(height), 1.5 * height


def _silver(resolution: int) -> dict[str, Any]:
    u, v = parts.grid(resolution)
    worn = 0.5 + 0.5 * np.sin(2 * np.pi * (6 * u + 2 * np.sin(2 * np.pi * v))) * np.cos(2 * np.pi * 3 * v)
    return parts.twosided(
        {
            "type": "principled",
            "base_color": parts.colour(0.85, 0.82, 0.75),
            "metallic": 1.0,
            "roughness": parts.bitmap(0.2 + 0.45 * worn),
        }
    )


_ALPHA = 0.06  # true roughness of the mirror

_TRIO_LAMPS = {
    "warm": ((-1.9, 1.9, 0.0), (21.0, 17.0, 12.0)),
    "cool": ((1.9, 2.0, 0.1), (12.0, 16.0, 21.0)),
    "near": ((0.3, 1.8, 3.2), (17.0, 15.0, 12.5)),
}
"""Position and radiance: at both sides of the objects, to light their backs, and near the camera, visible in the mirror."""


@register(name="mirror-trio", position=8)
@dataclass(frozen=True)
class MirrorTrio(fields.Rendered):
    """The roughness of a mirror behind three diffuse objects, from an image of which it covers a part.

    One view. One unknown, the alpha of a rough conductor, a number. Path gradients reach it well. The difficulty is to sample the few
    informative pixels, some of which are also noisy.
    """

    resolution: int = fields.resolution(64)
    max_depth: int = fields.max_depth(5, at_least=3)

    def scene(self) -> dict[str, Any]:
        """Return the objects on a floor y = 0 around z = 0, the mirror at z = -1 before a wall, and the camera at z = 4."""
        silver = {"type": "roughconductor", "material": "Ag", "alpha": _ALPHA, "distribution": "ggx"}
        t = np.linspace(0, 1, 48)
        cone = meshes.lathe(0.32 * (1 - t) + 1e-3, 0.85 * t, 64) + np.array([-0.02, 0.0, 0.15])
        return {
            "type": "scene",
            "camera": parts.camera((0.0, 1.25, 4.0), (0.0, 0.68, 0.0), 34.0, self.resolution),
            "sky": {"type": "constant", "radiance": parts.colour(0.12)},
            "floor": parts.rectangle((0, 0, 0), (6, 0, 0), (0, 0, -6), parts.diffuse(0.42, 0.36, 0.3)),
            "wall": parts.rectangle((0, 2, -1.3), (6, 0, 0), (0, 2, 0), parts.diffuse(0.3, 0.36, 0.4)),
            "mirror": parts.rectangle((0.1, 0.95, -1.0), (0.5, 0, 0), (0, 0.4, 0.03), silver),
            "frame": parts.rectangle(
                (0.1, 0.95, -1.02), (0.56, 0, 0), (0, 0.46, 0.035), parts.diffuse(0.1, 0.06, 0.04)
            ),
            "ball": parts.sphere([-0.78, 0.34, 0.1], 0.34, parts.diffuse(0.75, 0.12, 0.08)),
            "cone": meshes.sheet("cone", cone, parts.twosided(parts.diffuse(0.85, 0.6, 0.1)), closed=True),
            "block": {
                "type": "cube",
                "to_world": _block((0.8, 0.28, 0.1), 0.28),
                "bsdf": parts.diffuse(0.1, 0.3, 0.65),
            },
            **{name: _lamp(place, (0, 0.5, 0), 0.28, radiance) for name, (place, radiance) in _TRIO_LAMPS.items()},
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the roughness, initially satin; from 0.25 on the loss decreases in the wrong direction."""
        return (Parameter("mirror.bsdf.alpha.value", initial=0.15, bounds=(0.01, 1.0)),)


def _block(centre: parts.Vector, half: float) -> Any:
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 28)
    return mi.ScalarTransform4f().translate(list(centre)) @ turn @ mi.ScalarTransform4f().scale(half)


_TURNS = 2.5


@register(name="spiral", position=5)
@dataclass(frozen=True)
class Spiral(fields.Rendered):
    """Base colour, metalness and roughness of a glossy spiral ribbon, together, by indirect light.

    One view. Five unknown numbers, or three maps of texture_resolution² texels, initially constant.
    """

    resolution: int = fields.resolution(96)
    texture_resolution: int = fields.integer(1, "texels along a side of each unknown map; 1: no maps, plain values")
    reference_spp: int = fields.reference_spp(1536)
    max_depth: int = fields.max_depth(6, at_least=3)
    loss: Loss = field(default=RelativeL2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room: x and y in [-1, 1], z in [-1, 2.2], with the spiral around the y axis, and the camera inside, looking along
        -z."""
        return {
            "type": "scene",
            "camera": parts.camera((0, 0.55, 2.1), (0, -0.12, 0), 36.0, self.resolution),
            **parts.room(parts.diffuse(0.7), left=parts.diffuse(0.55, 0.2, 0.1), right=parts.diffuse(0.1, 0.3, 0.55)),
            **parts.uplight((-0.7, -0.999, 1.6), (40e3, 37e3, 33e3)),
            **parts.uplight((0.7, -0.999, -0.6), (22e3, 24e3, 30e3), name="second"),
            "spiral": meshes.sheet("spiral", _ribbon(24, 400), _lacquer(self.texture_resolution)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        leaf = "value" if self.texture_resolution == 1 else "data"
        start = {"base_color": 0.5, "metallic": 0.3, "roughness": 0.6}
        return tuple(Parameter(f"spiral.bsdf.brdf_0.{name}.{leaf}", initial=value) for name, value in start.items())


def _ribbon(rows: int, columns: int) -> np.ndarray:
    """Return a ribbon that climbs and narrows as it winds: points (rows, columns, 3)."""
    across, along = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    angle = 2 * np.pi * _TURNS * along
    radius = 0.62 - 0.32 * along
    height = -0.82 + 1.25 * along + 0.16 * across
    return np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=-1)


def _lacquer(resolution: int) -> dict[str, Any]:
    """Return copper or, for more than one texel, bands of copper and blue enamel with roughness increasing along the ribbon's width."""
    copper, blue = np.array([0.85, 0.42, 0.2]), np.array([0.08, 0.25, 0.5])
    if resolution == 1:
        unknown: dict[str, Any] = {"base_color": parts.colour(*copper), "metallic": 0.8, "roughness": 0.3}
    else:
        u, v = parts.grid(resolution)
        bands = parts.ramp(np.sin(6 * np.pi * u), -0.4, 0.4)[..., None]
        unknown = {
            "base_color": parts.bitmap(blue + (copper - blue) * bands),
            "metallic": parts.bitmap(0.1 + 0.8 * parts.ramp(np.cos(4 * np.pi * u), -0.5, 0.5)),
            "roughness": parts.bitmap(0.2 + 0.45 * v),
        }
    return parts.twosided({"type": "principled", **unknown})
