"""Problems `lamp`, `ajar`, `plain-and-textured`, `indirect-room` and `wall`: paint in rooms with a lamp.

In `lamp`, light and albedo multiply: a mural of half the albedo under a lamp of twice the radiance looks the same. They are distinguished
by the bulb, which the camera sees, and by the plaster and the floor, whose albedos are known. `ajar` is after Balint et al. 2023, Fig. 6,
and Veach's scene on which it is based. Nearly every emitter sample is occluded by the wall. Light passes the gap of the door, mostly after
a bounce in the corridor, and few samples see it. `plain-and-textured` is the case for several resolutions in adaptive pixel sampling
(Fig. 5 of its paper). All pixels of the bin depend on the same three numbers, whereas the pixels of the cushion depend on different ones.
Judged individually, both seem to deserve as many samples, although the bin needs almost none.

The lamp of `indirect-room` stands on the floor and points up, in a shade that is black inside. Only the ceiling sees it. From anywhere
else no emitter can be sampled, and with few samples per pixel the image is mostly noise. With the L1 loss this noise also biases the
gradient of a plain loop. `wall` is the simplest texture problem with noise. Sixteen pixels show every texel, and the best step of each is
nearly known from the image alone. Without noise, a few steps of the right length would suffice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.geometry import rotation
from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.losses import L1, Loss, RelativeL2
from unrender.preconditioners import LargeSteps
from unrender.scene.parameter import Parameter


@register(name="indirect-room", position=1)
@dataclass(frozen=True)
class IndirectRoom(fields.Rendered):
    """A photograph on the back wall of a room that is lit only by light bounced off its ceiling.

    One view. One unknown, the wall's reflectance (texture_resolution², 3), initially grey, with LargeSteps.
    """

    resolution: int = fields.resolution(128)
    texture_resolution: int = fields.texture_resolution(64)
    reference_spp: int = fields.reference_spp(1536)
    max_depth: int = fields.max_depth(6, at_least=3)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room: x and y in [-1, 1], z in [-1, 2.2], with the camera inside, looking along -z."""
        picture = parts.bitmap(parts.photograph("astronaut", self.texture_resolution))
        room = parts.room(parts.diffuse(0.75), parts.diffuse(0.6, 0.08, 0.06), parts.diffuse(0.12, 0.42, 0.1))
        return {
            "type": "scene",
            "camera": parts.camera((0, 0, 2.1), (0, 0, -1), 40.0, self.resolution),
            **room,
            "back": parts.rectangle((0, 0, -1), (1, 0, 0), (0, 1, 0), {"type": "diffuse", "reflectance": picture}),
            **parts.uplight((0.0, -0.999, 0.5), (40e3, 36e3, 30e3)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the wall's texture, initially grey, with LargeSteps as in the paper's reconstruction (Fig. 9)."""
        return (Parameter("back.bsdf.reflectance.data", initial=0.5, preconditioner=LargeSteps(2.0)),)


@register(name="wall", position=26)
@dataclass(frozen=True)
class Wall(fields.Rendered):
    """A photograph of few texels on a wall that fills the image, lit only by indirect light.

    One view. One unknown, the wall's reflectance (texture_resolution², 3), initially grey. The room is that of `indirect-room`.
    """

    resolution: int = fields.resolution(80)
    texture_resolution: int = fields.texture_resolution(20)
    reference_spp: int = fields.reference_spp(3072)
    max_depth: int = fields.max_depth(6, at_least=3)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room, with a camera whose image ends at the edges of the wall, 3.1 away and 2 wide."""
        room = IndirectRoom(texture_resolution=self.texture_resolution).scene()
        fov = math.degrees(2 * math.atan(1 / 3.1))
        return {**room, "camera": parts.camera((0, 0, 2.1), (0, 0, -1), fov, self.resolution)}

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("back.bsdf.reflectance.data", initial=0.5),)


_BULB = np.array([0.86, 1.68, -0.25])  # centre of the bulb


@register(name="lamp", position=4)
@dataclass(frozen=True)
class Lamp(fields.Rendered):
    """The radiance of a hanging lamp together with the mural that it lights.

    One view. Two unknowns: the lamp's colour (3,), initially dim white, and the mural (texture_resolution², 3), initially grey.
    """

    resolution: int = fields.resolution(128)
    texture_resolution: int = fields.texture_resolution(64)
    reference_spp: int = fields.reference_spp(384)
    max_depth: int = fields.max_depth(6, at_least=2)
    loss: Loss = field(default=RelativeL2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room: x in [-1.6, 1.6], y in [0, 2.2], z in [-1.2, 2.6], with the camera at its front, looking along -z."""
        plaster = parts.diffuse(0.7)
        mural = parts.bitmap(parts.photograph("coffee", self.texture_resolution))
        return {
            "type": "scene",
            "camera": parts.camera((0, 1.05, 2.5), (0, 1.05, -1.2), 47.0, self.resolution),
            "mural": parts.rectangle(
                (-0.5, 1.1, -1.199), (0.95, 0, 0), (0, 0.95, 0), {"type": "diffuse", "reflectance": mural}
            ),
            "back": parts.rectangle((0, 1.1, -1.2), (1.6, 0, 0), (0, 1.1, 0), plaster),
            "left": parts.rectangle((-1.6, 1.1, 0.7), (0, 0, -1.9), (0, 1.1, 0), plaster),
            "right": parts.rectangle((1.6, 1.1, 0.7), (0, 0, 1.9), (0, 1.1, 0), plaster),
            "front": parts.rectangle((0, 1.1, 2.6), (-1.6, 0, 0), (0, 1.1, 0), plaster),
            "floor": parts.rectangle((0, 0, 0.7), (1.6, 0, 0), (0, 0, -1.9), parts.diffuse(0.35, 0.25, 0.18)),
            "ceiling": parts.rectangle((0, 2.2, 0.7), (1.6, 0, 0), (0, 0, 1.9), plaster),
            "bulb": parts.sphere(_BULB, 0.12, parts.diffuse(0.0), emitter=parts.light(60.0, 45.0, 28.0)),
            "shade": meshes.sheet(
                "shade", _shade_points(48), parts.twosided(parts.diffuse(0.6, 0.3, 0.2)), closed=True
            ),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the lamp's radiance, whose scale needs its own learning rate, and the mural."""
        return (
            Parameter("bulb.emitter.radiance.value", initial=20.0, learning_rate=0.5),
            Parameter("mural.bsdf.reflectance.data", initial=0.5),
        )


def _shade_points(columns: int) -> np.ndarray:
    """Return a cone, closed at the top, whose lower edge is level with the centre of the bulb."""
    radius = np.array([0.34, 0.3, 0.26, 0.22, 0.18, 0.14, 0.07, 1e-3])
    height = np.array([0.0, 0.06, 0.12, 0.18, 0.24, 0.3, 0.31, 0.31])
    return meshes.lathe(radius, height, columns) + _BULB


_LEAVES = 7


@register(name="ajar", position=6)
@dataclass(frozen=True)
class Ajar(fields.Rendered):
    """The paint of a wall and the textures of a potted plant, in a room lit through a door ajar.

    One view. Three unknown reflectances of texture_resolution² texels, initially grey, with LargeSteps.
    """

    resolution: int = fields.resolution(96)
    texture_resolution: int = fields.texture_resolution(32)
    reference_spp: int = fields.reference_spp(2048)
    max_depth: int = fields.max_depth(6, at_least=3)
    loss: Loss = field(default=RelativeL2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room: x in [-1.5, 1.5], y in [0, 2], z in [-1, 2]; the corridor is at x < -1.5; the camera looks along -z."""
        grey, white = parts.diffuse(0.5), parts.twosided(parts.diffuse(0.7))
        size = self.texture_resolution
        wall = {"type": "diffuse", "reflectance": parts.bitmap(parts.photograph("coffee", size))}
        clay = {"type": "diffuse", "reflectance": parts.bitmap(_glaze(size))}
        return {
            "type": "scene",
            "camera": parts.camera((0.25, 0.95, 1.95), (0.1, 0.8, -1), 58.0, self.resolution),
            "back": parts.rectangle((0, 1, -1), (1.5, 0, 0), (0, 1, 0), wall),
            "right": parts.rectangle((1.5, 1, 0.5), (0, 0, 1.5), (0, 1, 0), parts.diffuse(0.6, 0.5, 0.35)),
            "front": parts.rectangle((0, 1, 2), (-1.5, 0, 0), (0, 1, 0), grey),
            "floor": parts.rectangle((-1, 0, 0.5), (2.5, 0, 0), (0, 0, -1.5), parts.diffuse(0.45, 0.35, 0.25)),
            "ceiling": parts.rectangle((-1, 2, 0.5), (2.5, 0, 0), (0, 0, 1.5), parts.diffuse(0.75)),
            **_doorway(white),
            **_corridor(white),
            "pot": meshes.sheet("pot", meshes.lathe(*_pot_profile(24), 48) + _PLACE, parts.twosided(clay), closed=True),
            "leaves": meshes.sheet("leaves", _rosette(20, 168) + _PLACE, _leaf(size), closed=True),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("back.bsdf.reflectance.data", initial=0.4, preconditioner=LargeSteps(2.0)),
            Parameter("pot.bsdf.brdf_0.reflectance.data", initial=0.4, preconditioner=LargeSteps(2.0)),
            Parameter("leaves.bsdf.brdf_0.reflectance.data", initial=0.4, preconditioner=LargeSteps(2.0)),
        )


_PLACE = np.array([0.55, 0.0, 0.1])
_OPENING = (-0.5, 0.3)  # of the doorway in z
_DOOR_HEIGHT = 1.7
_ANGLE = np.radians(28)  # by which the door stands open, into the corridor


def _doorway(bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return the wall at x = -1.5 around the doorway, and the door, hinged at its near edge."""
    low, high = _OPENING
    pieces = {
        "left_far": ((low - 1) / 2, 1.0, (low + 1) / 2, 1.0),
        "left_near": ((high + 2) / 2, 1.0, (2 - high) / 2, 1.0),
        "left_above": ((low + high) / 2, (_DOOR_HEIGHT + 2) / 2, (high - low) / 2, (2 - _DOOR_HEIGHT) / 2),
    }
    items: dict[str, Any] = {
        name: parts.rectangle((-1.5, y, z), (0, 0, -half), (0, tall, 0), bsdf)
        for name, (z, y, half, tall) in pieces.items()
    }
    width = high - low
    direction = np.array([-np.sin(_ANGLE), 0.0, -np.cos(_ANGLE)])
    centre = np.array([-1.5, _DOOR_HEIGHT / 2, high]) + direction * width / 2
    items["door"] = parts.rectangle(centre, direction * width / 2, (0, _DOOR_HEIGHT / 2, 0), bsdf)
    return items


def _corridor(bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return the corridor, x in [-3.5, -1.5], with a lamp below its ceiling behind the door."""
    return {
        "beyond": parts.rectangle((-3.5, 1, 0.5), (0, 0, -1.5), (0, 1, 0), bsdf),
        "corridor_far": parts.rectangle((-2.5, 1, -1), (1, 0, 0), (0, 1, 0), bsdf),
        "corridor_near": parts.rectangle((-2.5, 1, 2), (-1, 0, 0), (0, 1, 0), bsdf),
        "light": parts.rectangle(
            (-2.6, 1.95, 0.4), (0.3, 0, 0), (0, 0, 0.3), parts.diffuse(0.0), emitter=parts.light(1900.0, 1750.0, 1550.0)
        ),
    }


def _pot_profile(rows: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0, 1, rows)
    return 0.2 + 0.1 * t + 0.035 * parts.ramp(t, 0.78, 0.82), 0.42 * t


def _glaze(resolution: int) -> np.ndarray:
    """Return terracotta with a cream zigzag and a blue rim."""
    u, v = parts.grid(resolution)
    clay, cream, blue = np.array([0.6, 0.24, 0.12]), np.array([0.85, 0.78, 0.6]), np.array([0.1, 0.2, 0.5])
    zigzag = np.abs(v - 0.55 - 0.15 * np.abs(((8 * u) % 1) - 0.5) * 2)
    painted = clay + (cream - clay) * (1 - parts.ramp(zigzag, 0.06, 0.12))[..., None]
    return painted + (blue - painted) * (1 - parts.ramp(v, 0.1, 0.16))[..., None]


def _rosette(rows: int, columns: int) -> np.ndarray:
    """Return leaves around a stem as one sheet, (rows, columns + 1, 3): the radius decreases between leaves, the tips bend down."""
    angle = np.linspace(-np.pi, np.pi, columns + 1)[None, :]
    reach = np.linspace(0.02, 1, rows)[:, None]
    lobe = np.abs(np.cos(_LEAVES / 2 * angle)) ** 0.8
    alternate = 0.75 + 0.25 * np.cos(2 * angle + 0.7)
    radius = reach * (0.12 + 0.5 * lobe * alternate)
    height = 0.42 + 0.95 * alternate * reach * (1 - 0.55 * reach * lobe) + 0.02 * np.sin(3 * np.pi * reach)
    return np.stack([radius * np.sin(angle), np.broadcast_to(height, radius.shape), radius * np.cos(angle)], axis=-1)


def _leaf(resolution: int) -> dict[str, Any]:
    u, v = parts.grid(resolution)
    veins = np.abs(np.sin(np.pi * (_LEAVES * u + 3 * v)))[..., None] ** 0.5
    young, old = np.array([0.5, 0.65, 0.35]), np.array([0.05, 0.22, 0.06])
    return parts.twosided({"type": "diffuse", "reflectance": parts.bitmap(young + (old - young) * veins)})


@register(name="plain-and-textured", position=10)
@dataclass(frozen=True)
class PlainAndTextured(fields.Rendered):
    """The colour of a bin together with the texture of a cushion, in a room.

    One view. Two unknown reflectances, (3,) and (texture_resolution², 3), initially grey, the texture with LargeSteps.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    reference_spp: int = fields.reference_spp(512)
    max_depth: int = fields.max_depth(5, at_least=2)

    def scene(self) -> dict[str, Any]:
        """Return the room of `parts.room` with a lamp in its ceiling, and bin and cushion on its floor y = -1."""
        cover = {"type": "diffuse", "reflectance": parts.bitmap(parts.photograph("chelsea", self.texture_resolution))}
        place = np.array([-0.46, -1.0, -0.3])
        return {
            "type": "scene",
            "camera": parts.camera((0.0, -0.05, 2.15), (0, -0.22, -0.4), 53.0, self.resolution),
            **parts.room(parts.diffuse(0.7, 0.68, 0.62), parts.diffuse(0.6, 0.1, 0.08), parts.diffuse(0.12, 0.4, 0.15)),
            "lamp": parts.rectangle(
                (0, 0.99, 0.1), (0.35, 0, 0), (0, 0, 0.35), parts.diffuse(0.0), emitter=parts.light(17.0, 15.5, 13.5)
            ),
            "bin": meshes.sheet(
                "bin", meshes.lathe(*_bin(40), 64) + place, parts.twosided(parts.diffuse(0.12, 0.3, 0.65)), closed=True
            ),
            "cushion": meshes.sheet("cushion", _cushion(33), parts.twosided(cover)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("bin.bsdf.brdf_0.reflectance.value", initial=0.5),
            Parameter("cushion.bsdf.brdf_0.reflectance.data", initial=0.5, preconditioner=LargeSteps(1.0)),
        )


def _bin(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radius and height of a bin with a rim, open at the top, without a visible bottom."""
    t = np.linspace(0, 1, rows)
    return 0.26 + 0.1 * t + 0.03 * parts.ramp(t, 0.9, 0.94), 0.85 * t


def _cushion(steps: int) -> np.ndarray:
    """Return a pillow that leans back, rotated a little to the left: points (steps, steps, 3)."""
    y, x = np.meshgrid(np.linspace(-1, 1, steps), np.linspace(-1, 1, steps), indexing="ij")
    # Thin seams that curve inwards between the corners.
    bulge = 0.22 * np.sqrt(np.clip((1 - x**2) * (1 - y**2), 0, None))
    x, y = x * (1 - 0.08 * (1 - y**2)), y * (1 - 0.08 * (1 - x**2))
    flat = np.stack([0.47 * x, 0.47 * y, bulge], -1)
    back, aside = rotation((1, 0, 0), np.radians(-20)), rotation((0, 1, 0), np.radians(-18))
    return flat @ back.T @ aside.T + np.array([0.42, -0.53, 0.05])
