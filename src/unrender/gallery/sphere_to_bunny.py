"""Problem `sphere-to-bunny`: the shape of an animal, from images from all sides under known light, by moving the vertices of a sphere."""

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

_CENTRE, _RADIUS = np.array([0.0, -0.15, 0.0]), 0.62
_SPACING = 0.035
_PARTS = (
    meshes.Ellipsoid((-0.1, -0.36, 0.0), (0.6, 0.44, 0.4), 12.0),
    meshes.Ellipsoid((-0.32, -0.5, 0.26), (0.3, 0.3, 0.16)),
    meshes.Ellipsoid((-0.32, -0.5, -0.26), (0.3, 0.3, 0.16)),
    meshes.Ellipsoid((0.3, -0.5, 0.0), (0.2, 0.3, 0.26)),
    meshes.Ellipsoid((0.42, 0.12, 0.0), (0.28, 0.25, 0.23), -15.0),
    meshes.Ellipsoid((0.64, 0.05, 0.0), (0.13, 0.12, 0.12)),
    meshes.Ellipsoid((0.26, 0.52, 0.16), (0.11, 0.38, 0.09), 18.0),
    meshes.Ellipsoid((0.26, 0.52, -0.16), (0.11, 0.38, 0.09), 18.0),
    meshes.Ellipsoid((-0.74, -0.36, 0.0), (0.14, 0.14, 0.14)),
)
"""Body, haunches, chest, head, muzzle, ears, tail."""
_BLEND = 0.02


@register(name="sphere-to-bunny", position=28)
@dataclass(frozen=True)
class SphereToBunny:
    """The shape of a sitting hare with two long ears, from images from all sides, by moving every vertex of a sphere.

    Several views. The unknown is the sphere's vertex positions, (3 V,) with V = 10 · 4^subdivisions + 2. The light is known: a sky and a
    sun. True positions of vertices are undefined; errors are distances between surfaces. The difficulty is that the ears must grow out of
    a sphere, and that few images show the gap between them.
    """

    resolution: int = fields.resolution(64)
    views: int = fields.integer(6, "cameras around the animal, alternately lower and higher", at_least=1, at_most=64)
    subdivisions: int = fields.integer(4, "s: the sphere has 10 · 4^s + 2 vertices", at_least=1, at_most=7)
    mesh: str = meshes.option("PLY or OBJ file of a body, in place of the one made by code")
    remesh_at: int = fields.integer(
        0, "step before which the mesh gets even triangles of half the edge (unrender[remesh]); 0 for never", at_least=0
    )
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the sphere under the sky and the sun."""
        points, faces = meshes.icosphere(self.subdivisions)
        return self._stage() | {"sphere": meshes.triangles("sphere", _CENTRE + _RADIUS * points, faces, _fur())}

    def target(self) -> dict[str, Any]:
        """Return the same scene with the animal in place of the sphere."""
        if self.mesh:
            return self._stage() | {"body": meshes.centred(self.mesh, _fur())}
        return self._stage() | {"body": meshes.triangles("body", *_animal(), _fur())}

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the vertices of the sphere."""
        return (Parameter("sphere.vertex_positions", remeshing=(self.remesh_at,) if self.remesh_at else None),)

    def problem(self, name: str) -> Problem:
        """Return the problem: the sphere's scene, references of the animal by Mitsuba's `path` integrator, and its surface."""
        true = load(self.target)
        body = next(shape for shape in true.shapes() if shape.is_mesh())
        surfaces = {"sphere.vertex_positions": meshes.surface(body)}
        return Problem(
            self.scene, self.parameters(), views_of(true, self), self.loss, self.max_depth, name=name, surfaces=surfaces
        )

    def _stage(self) -> dict[str, Any]:
        angles = 2 * np.pi * (np.arange(self.views) + 0.25) / self.views
        fov = 44.0 if self.mesh else 36.0  # a mesh from a file may fill its bounding box
        return {
            "type": "scene",
            **parts.cameras_around(angles, 3.6, (0.4, 2.0), (0, 0, 0), fov, self.resolution),
            "sky": {"type": "constant", "radiance": parts.colour(0.25, 0.3, 0.4)},
            "sun": staging.sun((0.5, 1.0, 0.4), 0.7),
        }


def _fur() -> dict[str, Any]:
    return parts.twosided(parts.diffuse(0.75, 0.6, 0.45))


def _animal() -> tuple[np.ndarray, np.ndarray]:
    return meshes.around(meshes.united(_PARTS, _BLEND), (-1.1, -1.0, -0.7), (1.0, 1.1, 0.7), _SPACING)
