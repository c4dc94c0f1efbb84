"""Problem `statue`: the shape of a bust and its texture together, from images from all sides."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, textures
from unrender.gallery.specification import views_of
from unrender.losses import L2, Loss
from unrender.rendering.mitsuba.scene_loading import load
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem

_RADIUS = 0.68
_FINE = 5
"""Subdivisions of the true mesh."""
_PROFILE = (
    *((-1.0, 0.0), (-0.97, 0.4), (-0.6, 0.66), (-0.38, 0.68), (-0.2, 0.34), (-0.05, 0.21)),
    *((0.1, 0.24), (0.3, 0.35), (0.55, 0.38), (0.78, 0.31), (0.95, 0.14), (1.0, 0.0)),
)
"""Heights and radii, from the foot to the crown."""


@register(name="statue", position=30)
@dataclass(frozen=True)
class Statue:
    """The shape of a bust together with the pattern of its stone, from images from all sides, starting with a grey sphere.

    Several views. The unknowns are the sphere's vertex positions, (3 V,), and the reflectance of its texture, (H, 2 H, 3). The light is
    known: a sky and a sun. Vertices may slide along the surface with the texture, so the texture has no true value; the error of the
    shape is the distance between surfaces. The difficulty is that each unknown can explain a part of the other.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    views: int = fields.integer(6, "cameras around the bust, alternately lower and higher", at_least=1, at_most=64)
    subdivisions: int = fields.integer(
        4, "s: the sphere has 10 · 4^s + 2 vertices, without those doubled at its seam", at_least=1, at_most=7
    )
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the grey sphere under the sky and the sun."""
        grey = np.full((self.texture_resolution, 2 * self.texture_resolution, 3), 0.5, np.float32)
        return self._stage() | {"statue": _body(lambda directions: _RADIUS * directions, self.subdivisions, grey)}

    def target(self) -> dict[str, Any]:
        """Return the bust of veined stone."""
        return self._stage() | {"statue": _body(_bust, _FINE, _stone(4 * self.texture_resolution))}

    def parameters(self) -> tuple[Parameter, ...]:
        """Return vertices and texture of the grey sphere."""
        return Parameter("statue.vertex_positions"), Parameter("statue.bsdf.brdf_0.reflectance.data")

    def problem(self, name: str) -> Problem:
        """Return the problem: the sphere's scene, references of the bust by Mitsuba's `path` integrator, and its surface."""
        true = load(self.target)
        surfaces = {"statue.vertex_positions": meshes.surface(next(s for s in true.shapes() if s.is_mesh()))}
        return Problem(
            self.scene, self.parameters(), views_of(true, self), self.loss, self.max_depth, name=name, surfaces=surfaces
        )

    def _stage(self) -> dict[str, Any]:
        angles = 2 * np.pi * (np.arange(self.views) + 0.25) / self.views
        return {
            "type": "scene",
            **parts.cameras_around(angles, 3.6, (0.3, 1.8), (0, 0, 0), 34.0, self.resolution),
            "sky": {"type": "constant", "radiance": parts.colour(0.3, 0.33, 0.4)},
            "sun": parts.sun((0.6, 0.9, 0.7), 0.6),
        }


def _body(place: Any, subdivisions: int, texture: np.ndarray) -> Any:
    directions, faces = meshes.icosphere(subdivisions)
    of, faces, coordinates = meshes.unrolled(directions, faces)
    stone = parts.twosided({"type": "diffuse", "reflectance": textures.bitmap(texture) | {"wrap_mode": "repeat"}})
    return meshes.triangles("statue", place(directions[of]), faces, stone, coordinates)


def _bust(directions: np.ndarray) -> np.ndarray:
    """Return head, neck and shoulders with a nose, from unit directions: (V, 3)."""
    from scipy.interpolate import PchipInterpolator

    x, y, z = directions.T
    height = np.arcsin(np.clip(y, -1, 1)) / (np.pi / 2)
    radius = PchipInterpolator(*np.transpose(_PROFILE))(height)
    shoulders = textures.ramp(-height, 0.0, 0.3)
    level = np.maximum(np.sqrt(np.maximum(1 - y * y, 0)), 1e-9)
    across, along = radius * x / level, radius * z / level
    nose = 0.14 * np.exp(-((x / 0.2) ** 2) - ((height - 0.38) / 0.09) ** 2) * (z > 0)
    return np.stack(
        [across, 0.95 * height, along * (1 - 0.42 * shoulders) + nose + 0.1 * textures.ramp(height, 0.0, 0.3)], -1
    )


def _stone(rows: int) -> np.ndarray:
    """Return bands and veins of two colours, (rows, 2 rows, 3) reflectance, periodic in each row."""
    u, v = np.meshgrid((np.arange(2 * rows) + 0.5) / (2 * rows), (np.arange(rows) + 0.5) / rows)
    around = 2 * np.pi * u
    veins = 0.5 + 0.5 * np.sin(3 * around + 9 * v + 1.5 * np.sin(2 * around + 14 * v))
    bands = textures.ramp(np.sin(2 * np.pi * 3.5 * v + np.sin(around)), -0.4, 0.4)
    warm, cold, dark = (np.array(c) for c in ((0.75, 0.55, 0.35), (0.35, 0.45, 0.6), (0.2, 0.14, 0.12)))
    mixed = warm + bands[..., None] * (cold - warm)
    return (mixed + 0.6 * veins[..., None] ** 4 * (dark - mixed)).astype(np.float32)
