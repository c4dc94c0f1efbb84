"""Problems `shadow` and `bunny`: poses of bodies. After Wang et al., section 4.

`shadow` is the position of a floating ball outside of the image, from its shadow on the floor. A shadow caster gets no path gradient from
its shadow, because visibility is discontinuous. Where the shadow does not overlap its true position, even the true loss is flat. `bunny`
is the task without a plateau, which gradients of the unsmoothed loss can solve as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.core.rotations import rotation
from unrender.gallery import fields, meshes, parts
from unrender.losses import L2, Loss
from unrender.scene.parameter import Parameter

_SUN = np.array([0.4, 1.0, -0.25])
_HEIGHT = 4.0
_RADIUS = 0.32
_TRUTH, _START = (0.4, -0.3), (-0.45, 0.35)
"""True centre of the shadow: x and z."""
_REACH = 0.6
"""Largest distance of the shadow from the centre of the image, in x and in z."""


@register(name="shadow", position=18)
@dataclass(frozen=True)
class Shadow:
    """The position of a ball outside of the image: two numbers, from its shadow, initially away from the true one.

    One view. The unknowns are x and z of the ball's translation, bounded so that its shadow is in the image. A plateau: the loss does not
    change until the shadows overlap. The renderer's path gradient is zero everywhere.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the floor y = 0, with the camera below the ball, looking straight down, so that the shadow's shape does not change."""
        above = (0, 3.2, 0)
        x, z = np.array(_TRUTH) + _HEIGHT * _SUN[[0, 2]] / _SUN[1]
        return {
            "type": "scene",
            "camera": parts.camera(above, (0, 0, 0), 35.0, self.resolution)
            | {"to_world": mi.ScalarTransform4f().look_at(list(above), [0, 0, 0], [0, 0, -1])},
            "sun": parts.sun(_SUN, 1.2),
            "floor": parts.rectangle((0, 0, 0), (6, 0, 0), (0, 0, -6), parts.diffuse(0.6, 0.5, 0.35)),
            "ball": {
                "type": "sphere",
                "center": [float(x), _HEIGHT, float(z)],
                "radius": _RADIUS,
                "bsdf": parts.diffuse(0.5),
            },
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the ball's position above the floor, relative to the truth."""
        unknowns: list[Parameter] = []
        for axis, truth, start in zip("xz", _TRUTH, _START, strict=True):
            unknowns += parts.unknown_pose(
                "ball", "translation", {axis: start - truth}, (-_REACH - truth, _REACH - truth)
            )
        return tuple(unknowns)


@register(name="bunny", position=19)
@dataclass(frozen=True)
class Bunny:
    """The position and direction of an animal: three numbers; the start overlaps the reference.

    One view. The unknowns are x and z of its translation, and its rotation about the vertical. There is no plateau: it starts a fraction
    of its size away, rotated by 30 degrees. The difficulty is that the three are correlated in the silhouette. The animal is made by
    code, or read from a file.
    """

    resolution: int = fields.resolution(48)
    mesh: str = meshes.option("PLY or OBJ file of an animal, y upwards, in place of the one made by code")
    detail: int = fields.integer(1, "d: the mesh made by code has about 3600 d^2 vertices", at_least=1, at_most=16)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the animal, 1 along its longest side, on the floor y = 0 at the origin, with the sun at the camera's left."""
        fur = parts.twosided(parts.diffuse(0.75, 0.6, 0.45))
        made = meshes.standing(self.mesh, fur) if self.mesh else meshes.sheets("bunny", _animal(self.detail), fur)
        return {
            "type": "scene",
            "camera": parts.camera((0.1, 2.0, 3.0), (0.1, 0.33, 0), 30.0, self.resolution),
            "sun": parts.sun((-0.6, 1.0, 0.7), 1.2),
            "floor": parts.rectangle((0, 0, 0), (6, 0, 0), (0, 0, -6), parts.diffuse(0.25, 0.4, 0.25)),
            "bunny": made,
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return position and direction relative to the truth."""
        return (
            *parts.unknown_pose("bunny", "translation", {"x": -0.22, "z": 0.25}, bounds=(-0.6, 0.6)),
            *parts.unknown_pose("bunny", "rotation", {"y": np.radians(30.0)}),
        )


def _animal(detail: int) -> list[meshes.Sheet]:
    """Return a sitting hare that looks along +x and slightly to the camera: body, haunch, chest, head, muzzle, two ears, a tail."""

    turn = rotation((0, 1, 0), np.radians(-35))  # from +x towards the camera

    def ball(centre: tuple[float, float, float], radii: tuple[float, float, float], tilt: float = 0.0) -> meshes.Sheet:
        axes = meshes.Ellipsoid(centre, radii, tilt).axes
        return meshes.Sheet(meshes.ellipsoid(axes, np.array(centre), 16 * detail, 24 * detail) @ turn.T)

    return [
        ball((-0.05, 0.27, 0), (0.36, 0.25, 0.23), 12),
        ball((-0.2, 0.2, 0.12), (0.2, 0.2, 0.13)),
        ball((-0.2, 0.2, -0.12), (0.2, 0.2, 0.13)),
        ball((0.2, 0.2, 0), (0.12, 0.2, 0.14)),
        ball((0.3, 0.53, 0), (0.17, 0.15, 0.14), -15),
        ball((0.43, 0.49, 0), (0.08, 0.07, 0.08)),
        ball((0.2, 0.8, 0.08), (0.06, 0.22, 0.04), 18),
        ball((0.2, 0.8, -0.08), (0.06, 0.22, 0.04), 18),
        ball((-0.42, 0.28, 0), (0.08, 0.08, 0.08)),
    ]
