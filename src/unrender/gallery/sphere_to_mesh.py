"""Problem `sphere-to-mesh`: the shape of a body, from images from all sides, by moving the vertices of a sphere.

After Wang et al., Fig. 5. True positions of vertices are undefined, only their surface is: many vertex distributions give the same
images.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, staging, textures
from unrender.gallery.specification import views_of
from unrender.losses import L2, Loss
from unrender.preconditioners import LargeSteps
from unrender.rendering.mitsuba.scene_loading import load
from unrender.rendering.picture_format import AOVS
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem

_RADIUS = 0.7
"""Radius of the sphere; the body fits into a ball of radius about 1."""


@register(name="sphere-to-mesh", position=21)
@dataclass(frozen=True)
class SphereToMesh:
    """The shape of a body seen from all sides, by moving every vertex of a sphere.

    Several views. The unknown is the sphere's vertex positions, (3 V,) with V = 10 · 4^subdivisions + 2, initially a sphere at the body's
    centre. There is no true value: vertices may slide along the surface. The difficulty is their number, that most information about a
    shape is in its silhouettes and shadows, and that only large steps (`strength`) keep the mesh smooth.
    """

    resolution: int = fields.resolution(48)
    views: int = fields.integer(6, "cameras around the body, alternately lower and higher", at_least=1, at_most=32)
    subdivisions: int = fields.integer(3, "s: the sphere has 10 · 4^s + 2 vertices", at_least=1, at_most=6)
    mesh: str = meshes.option("PLY or OBJ file of the body, in place of the one made by code")
    reference_spp: int = fields.reference_spp(512)
    max_depth: int = fields.max_depth(2, at_least=2)
    strength: int = fields.integer(0, "λ of large steps (LargeSteps) on the mesh, 0 for none; 19 is usual", at_least=0)
    pictures: str = fields.choice("colour", f"what the images contain: colour, {', '.join(AOVS)}", ("colour", *AOVS))
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the sphere floating over a floor, under a sun, with cameras that look down, so that the floor shows its dark side's
        outline. Masks are of the sphere alone."""
        points, faces = meshes.icosphere(self.subdivisions)
        return self._stage() | {"sphere": meshes.triangles("sphere", _RADIUS * points, faces, _clay())}

    def target(self) -> dict[str, Any]:
        """Return the same scene with the body in place of the sphere."""
        if self.mesh:
            return self._stage() | {"body": meshes.centred(self.mesh, _clay())}
        points, faces = meshes.icosphere(5)
        return self._stage() | {"body": meshes.triangles("body", _body(points), faces, _clay())}

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the vertices of the sphere."""
        smooth = LargeSteps(float(self.strength)) if self.strength else None
        return (Parameter("sphere.vertex_positions", preconditioner=smooth),)

    def problem(self, name: str) -> Problem:
        """Return the problem: the sphere's scene, and references of the body by Mitsuba's `path` integrator."""
        views = views_of(load(self.target), self, "" if self.pictures == "colour" else self.pictures)
        return Problem(self.scene, self.parameters(), views, self.loss, self.max_depth, name=name)

    def _stage(self) -> dict[str, Any]:
        floor = parts.rectangle((0, -1.3, 0), (20, 0, 0), (0, 0, -20), parts.diffuse(0.12, 0.18, 0.25))
        angles = 2 * np.pi * np.arange(self.views) / self.views
        return {
            "type": "scene",
            **parts.cameras_around(angles, 3.8, (1.9, 3.2), (0, -0.1, 0), 34.0, self.resolution),
            "sun": staging.sun((0.35, 1.0, 0.45), 1.0),
            **({} if self.pictures == "mask" else {"floor": floor}),
        }


def _clay() -> dict[str, Any]:
    return parts.twosided(parts.diffuse(0.8, 0.7, 0.55))


def _body(directions: np.ndarray) -> np.ndarray:
    """Return a pear with a bent neck and a dent in its side, from unit directions: (V, 3)."""
    x, y, z = directions.T
    neck = textures.ramp(y, -0.1, 0.9)
    width = 0.78 - 0.42 * neck - 0.18 * np.exp(-((x - 0.9) ** 2 + (y + 0.2) ** 2 + z**2) / 0.12)
    return np.stack([width * x + 0.3 * neck**2, 0.9 * y - 0.05, width * z - 0.1 * neck**2], -1)
