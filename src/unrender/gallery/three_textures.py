"""`three-textures`: the paint of a ball, a jar and a cone, found together, outdoors.

The joint albedo of three objects of the adaptive sampling of pixels (its Fig. 1). Most pixels show the ground, which tells next to nothing
of the paint; those of the things differ in what they tell: the sides in the sun are bright, those in the shade are lit by the sky and by
what the ground gives back.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, textures, two_planets
from unrender.losses import L2, Loss
from unrender.preconditioners import LargeSteps
from unrender.scene.parameter import Parameter

_SUN = np.array([0.45, 0.7, 0.55]) / np.linalg.norm([0.45, 0.7, 0.55])
"""Direction to the sun."""
_APART = 0.72
"""Distance of each thing from the middle."""


@register(name="three-textures", position=31)
@dataclass(frozen=True)
class ThreeTextures:
    """The paint of three things at once under a sky with a sun, seen from all around.

    Several views; three unknown reflectances of texture_resolution² texels, from grey, with LargeSteps. Of the ball's lower end no
    picture tells.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    views: int = fields.integer(4, "cameras, evenly around the things", at_least=1, at_most=32)
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(4, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """The things on the ground y = 0, each at 0.72 from the y axis, the ball towards +z."""
        angles = 0.5 + 2 * np.pi * np.arange(self.views) / self.views
        rows, columns = 48, 96
        ball = meshes.ellipsoid(0.45 * np.eye(3), np.array([0.0, 0.45, 0.0]), rows, columns)
        jar, cone = meshes.lathe(*_jar(rows), columns), meshes.lathe(*_cone(rows), columns)
        planet = textures.bitmap(two_planets.blue(self.texture_resolution))
        return {
            "type": "scene",
            **{
                f"camera_{number}": parts.camera(
                    (4.4 * np.sin(a), 2.2, 4.4 * np.cos(a)), (0, 0.4, 0), 32.0, self.resolution
                )
                for number, a in enumerate(angles)
            },
            "sky": parts.environment(parts.picture(_SUN, np.radians(8.0), (45.0, 40.0, 32.0))),
            "ground": parts.rectangle((0, 0, 0), (30, 0, 0), (0, 0, -30), parts.diffuse(0.3, 0.27, 0.22)),
            "ball": _painted("ball", ball + _place(0), planet),
            "jar": _painted("jar", jar + _place(1), self._photograph("chelsea")),
            "cone": _painted("cone", cone + _place(2), self._photograph("coffee")),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """The three paints, grey at first."""
        smooth = LargeSteps(1.0)
        return tuple(
            Parameter(f"{name}.bsdf.reflectance.data", initial=0.5, preconditioner=smooth)
            for name in ("ball", "jar", "cone")
        )

    def _photograph(self, name: textures.Photograph) -> dict[str, Any]:
        """Upright, once on either half of what it goes around, mirrored."""
        return textures.bitmap(textures.photograph(name, self.texture_resolution)[::-1], repeat=(2, 1))


def _painted(name: str, points: np.ndarray, texture: dict[str, Any]) -> Any:
    return meshes.sheet(name, points, {"type": "diffuse", "reflectance": texture}, closed=True)


def _place(number: int) -> np.ndarray:
    angle = 2 * np.pi * number / 3
    return np.array([_APART * np.sin(angle), 0.0, _APART * np.cos(angle)])


def _jar(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Radius and height of a drum with round edges, closed above and below."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, rows)
    return 0.42 * np.cos(angle) ** 0.5 + 1e-3, 0.45 + 0.45 * np.sin(angle)


def _cone(rows: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0, 1, rows)
    return 0.46 * (1 - t) + 1e-3, 1.05 * t
