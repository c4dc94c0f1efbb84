"""Problem `shadow-art`: one body that casts two given shadows.

After Mitra and Pauly 2009, "Shadow Art". No camera sees the body, only its shadows on two walls.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, staging
from unrender.gallery.specification import views_of
from unrender.losses import L2, Loss
from unrender.rendering.mitsuba.scene_loading import load
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem

_RADIUS = 0.7
_WALL = 3.4
_SPACING = 0.05


@register(name="shadow-art", position=29)
@dataclass(frozen=True)
class ShadowArt:
    """A body whose shadows are a heart on one wall and a fir tree on the other, by moving every vertex of a sphere.

    Two views, each of a wall with the shadow of one sun. The unknown is the sphere's vertex positions, (3 V,) with V = 10 ·
    4^subdivisions + 2. No image shows the body. Many bodies cast these shadows, so there is no true value; errors are those of the
    images. The difficulty is that gradients come from shadow boundaries only, and that each vertex affects two of them.
    """

    resolution: int = fields.resolution(64)
    subdivisions: int = fields.integer(4, "s: the sphere has 10 · 4^s + 2 vertices", at_least=1, at_most=7)
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the sphere between two suns and two walls."""
        points, faces = meshes.icosphere(self.subdivisions)
        return self._stage() | {"sphere": meshes.triangles("sphere", _RADIUS * points, faces, _clay())}

    def target(self) -> dict[str, Any]:
        """Return the same scene with a body in place of the sphere: the largest body with the two outlines."""
        points, faces = meshes.around(_depth, (-1.2, -1.2, -1.2), (1.2, 1.2, 1.2), _SPACING)
        return self._stage() | {"body": meshes.triangles("body", points, faces, _clay())}

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the vertices of the sphere."""
        return (Parameter("sphere.vertex_positions"),)

    def problem(self, name: str) -> Problem:
        """Return the problem: the sphere's scene, and references of the two shadows by Mitsuba's `path` integrator."""
        views = views_of(load(self.target), self)
        return Problem(self.scene, self.parameters(), views, self.loss, self.max_depth, name=name)

    def _stage(self) -> dict[str, Any]:
        """Return suns, walls and cameras.

        Each camera is between the body and a wall, and faces the wall; each sun lights one wall only.
        """
        wall, half = parts.diffuse(0.7, 0.65, 0.55), 1.7
        return {
            "type": "scene",
            "camera_back": parts.camera((0, 0, -1.3), (0, 0, -_WALL), 62.0, self.resolution),
            "camera_left": parts.camera((-1.3, 0, 0), (-_WALL, 0, 0), 62.0, self.resolution),
            "sun_back": staging.sun((0, 0, 1), 1.0),
            "sun_left": staging.sun((1, 0, 0), 1.0),
            "back": parts.rectangle((0, 0, -_WALL), (half, 0, 0), (0, half, 0), wall),
            "left": parts.rectangle((-_WALL, 0, 0), (0, 0, -half), (0, half, 0), wall),
        }


def _clay() -> dict[str, Any]:
    return parts.twosided(parts.diffuse(0.5))


def _depth(points: np.ndarray) -> np.ndarray:
    """Return the depth in the intersection of the two outlines, extruded along z and x."""
    x, y, z = points.T
    return np.minimum(_heart(x, y), _fir(z, y))


def _heart(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a depth, positive inside of the curve (a² + b² − 1)³ = a² b³, y from -1 to 1; approximately a distance near it."""
    a, b = 1.16 * x, 1.1 * y + 0.12
    value = np.square(a) * b**3 - (np.square(a) + np.square(b) - 1) ** 3
    return 0.2 * np.cbrt(value)


def _fir(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the depth in three tiers on a trunk, y from -1 to 1."""
    tiers = [
        np.minimum((top - y) * slope - np.abs(x), y - foot)
        for top, foot, slope in ((1.0, 0.3, 0.75), (0.6, -0.2, 0.8), (0.2, -0.7, 0.8))
    ]
    trunk = np.minimum(np.minimum(0.16 - np.abs(x), y + 1.0), -0.6 - y)
    return np.maximum.reduce([*tiers, trunk]) * 0.8
