"""Problem `three-textures`: the paint of a ball, a jar and a cone, together, outdoors.

The joint albedo of three objects of adaptive pixel sampling (Fig. 1 of its paper). Most pixels show the ground, which contains almost no
information about the paint. Pixels of the objects differ: the sides in the sun are bright, while the sky and the ground light the shaded
sides.
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
"""Distance of each object from the centre."""


@register(name="three-textures", position=31)
@dataclass(frozen=True)
class ThreeTextures:
    """The paint of three objects under a sky with a sun, seen from all sides.

    Several views. Three unknown reflectances of texture_resolution² texels, initially grey, with LargeSteps. No image shows the lower end
    of the ball.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    views: int = fields.integer(4, "cameras, at equal angles around the objects", at_least=1, at_most=32)
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(4, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the objects on the ground y = 0, each at 0.72 from the y axis, the ball at +z."""
        angles = 0.5 + 2 * np.pi * np.arange(self.views) / self.views
        rows, columns = 48, 96
        ball = meshes.ellipsoid(0.45 * np.eye(3), np.array([0.0, 0.45, 0.0]), rows, columns)
        jar, cone = meshes.lathe(*_jar(rows), columns), meshes.lathe(*_cone(rows), columns)
        planet = textures.bitmap(two_planets.blue(self.texture_resolution))
        return {
            "type": "scene",
            **parts.cameras_around(angles, 4.4, (2.2,), (0, 0.4, 0), 32.0, self.resolution),
            "sky": parts.environment(parts.picture(_SUN, np.radians(8.0), (45.0, 40.0, 32.0))),
            "ground": parts.rectangle((0, 0, 0), (30, 0, 0), (0, 0, -30), parts.diffuse(0.3, 0.27, 0.22)),
            "ball": _painted("ball", ball + _place(0), planet),
            "jar": _painted("jar", jar + _place(1), self._photograph("chelsea")),
            "cone": _painted("cone", cone + _place(2), self._photograph("coffee")),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the three paints, initially grey."""
        smooth = LargeSteps(1.0)
        return tuple(
            Parameter(f"{name}.bsdf.reflectance.data", initial=0.5, preconditioner=smooth)
            for name in ("ball", "jar", "cone")
        )

    def _photograph(self, name: textures.Photograph) -> dict[str, Any]:
        """Return an upright photograph, once on either half of the circumference, mirrored."""
        return textures.bitmap(textures.photograph(name, self.texture_resolution)[::-1], repeat=(2, 1))


def _painted(name: str, points: np.ndarray, texture: dict[str, Any]) -> Any:
    return meshes.sheet(name, points, {"type": "diffuse", "reflectance": texture}, closed=True)


def _place(number: int) -> np.ndarray:
    angle = 2 * np.pi * number / 3
    return np.array([_APART * np.sin(angle), 0.0, _APART * np.cos(angle)])


def _jar(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radius and height of a drum with round edges, closed at the top and bottom."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, rows)
    return 0.42 * np.cos(angle) ** 0.5 + 1e-3, 0.45 + 0.45 * np.sin(angle)


def _cone(rows: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0, 1, rows)
    return 0.46 * (1 - t) + 1e-3, 1.05 * t
