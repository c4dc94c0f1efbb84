"""Problems `sphere-to-mesh`, `sphere-to-bunny`, `shadow-art` and `statue`: a body from images, by moving the vertices of a sphere.

After Wang et al., Fig. 5, and Mitra and Pauly 2009, "Shadow Art", in which no camera sees the body, only its shadows on two walls. True
positions of vertices are undefined, only their surface is: many vertex distributions give the same images. In `statue`, the texture of the
body is unknown, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.gallery.specification import reconstruction
from unrender.preconditioners import LargeSteps
from unrender.rendering import AOVS
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem

_RADIUS = 0.7  # radius of the sphere; the body fits into a ball of radius about 1


@register(name="sphere-to-mesh", position=21)
@dataclass(frozen=True)
class SphereToMesh(fields.Rendered):
    """The shape of a body seen from all sides, by moving every vertex of a sphere.

    Several views. The unknown is the sphere's vertex positions, (3 V,) with V = 10 · 4^subdivisions + 2, initially a sphere at the body's
    centre. There is no true value: vertices may slide along the surface. The difficulty is their number, that most information about a
    shape is in its silhouettes and shadows, and that only large steps (`strength`) keep the mesh smooth.
    """

    views: int = fields.integer(6, "cameras around the body, alternately lower and higher", at_least=1, at_most=32)
    subdivisions: int = fields.integer(3, "s: the sphere has 10 · 4^s + 2 vertices", at_least=1, at_most=6)
    mesh: str = meshes.option("PLY or OBJ file of the body, in place of the one made by code")
    reference_spp: int = fields.reference_spp(512)
    strength: int = fields.integer(0, "λ of large steps (LargeSteps) on the mesh, 0 for none; 19 is usual", at_least=0)
    pictures: str = fields.choice("colour", f"what the images contain: colour, {', '.join(AOVS)}", ("colour", *AOVS))

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
        smooth = LargeSteps(float(self.strength)) if self.strength else None
        return (Parameter("sphere.vertex_positions", preconditioner=smooth),)

    def problem(self, name: str) -> Problem:
        return reconstruction(name, self, "" if self.pictures == "colour" else self.pictures)

    def _stage(self) -> dict[str, Any]:
        floor = parts.rectangle((0, -1.3, 0), (20, 0, 0), (0, 0, -20), parts.diffuse(0.12, 0.18, 0.25))
        angles = 2 * np.pi * np.arange(self.views) / self.views
        return {
            "type": "scene",
            **parts.cameras_around(angles, 3.8, (1.9, 3.2), (0, -0.1, 0), 34.0, self.resolution),
            "sun": parts.sun((0.35, 1.0, 0.45), 1.0),
            **({} if self.pictures == "mask" else {"floor": floor}),
        }


def _clay() -> dict[str, Any]:
    return parts.twosided(parts.diffuse(0.8, 0.7, 0.55))


def _body(directions: np.ndarray) -> np.ndarray:
    """Return a pear with a bent neck and a dent in its side, from unit directions: (V, 3)."""
    x, y, z = directions.T
    neck = parts.ramp(y, -0.1, 0.9)
    width = 0.78 - 0.42 * neck - 0.18 * np.exp(-((x - 0.9) ** 2 + (y + 0.2) ** 2 + z**2) / 0.12)
    return np.stack([width * x + 0.3 * neck**2, 0.9 * y - 0.05, width * z - 0.1 * neck**2], -1)


_CENTRE = np.array([0.0, -0.15, 0.0])
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
class SphereToBunny(fields.Rendered):
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

    def scene(self) -> dict[str, Any]:
        """Return the sphere under the sky and the sun."""
        points, faces = meshes.icosphere(self.subdivisions)
        return self._stage() | {"sphere": meshes.triangles("sphere", _CENTRE + 0.62 * points, faces, _fur())}

    def target(self) -> dict[str, Any]:
        """Return the same scene with the animal in place of the sphere."""
        if self.mesh:
            return self._stage() | {"body": meshes.centred(self.mesh, _fur())}
        return self._stage() | {"body": meshes.triangles("body", *_animal(), _fur())}

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("sphere.vertex_positions", remeshing=(self.remesh_at,) if self.remesh_at else None),)

    def problem(self, name: str) -> Problem:
        return reconstruction(name, self, surface_of="sphere.vertex_positions")

    def _stage(self) -> dict[str, Any]:
        angles = 2 * np.pi * (np.arange(self.views) + 0.25) / self.views
        fov = 44.0 if self.mesh else 36.0  # a mesh from a file may fill its bounding box
        return {
            "type": "scene",
            **parts.cameras_around(angles, 3.6, (0.4, 2.0), (0, 0, 0), fov, self.resolution),
            "sky": {"type": "constant", "radiance": parts.colour(0.25, 0.3, 0.4)},
            "sun": parts.sun((0.5, 1.0, 0.4), 0.7),
        }


def _fur() -> dict[str, Any]:
    return parts.twosided(parts.diffuse(0.75, 0.6, 0.45))


def _animal() -> tuple[np.ndarray, np.ndarray]:
    return meshes.around(meshes.united(_PARTS, _BLEND), (-1.1, -1.0, -0.7), (1.0, 1.1, 0.7), 0.035)


_WALL = 3.4


@register(name="shadow-art", position=29)
@dataclass(frozen=True)
class ShadowArt(fields.Rendered):
    """A body whose shadows are a heart on one wall and a fir tree on the other, by moving every vertex of a sphere.

    Two views, each of a wall with the shadow of one sun. The unknown is the sphere's vertex positions, (3 V,) with V = 10 ·
    4^subdivisions + 2. No image shows the body. Many bodies cast these shadows, so there is no true value; errors are those of the
    images. The difficulty is that gradients come from shadow boundaries only, and that each vertex affects two of them.
    """

    resolution: int = fields.resolution(64)
    subdivisions: int = fields.integer(4, "s: the sphere has 10 · 4^s + 2 vertices", at_least=1, at_most=7)
    reference_spp: int = fields.reference_spp(256)

    def scene(self) -> dict[str, Any]:
        """Return the sphere between two suns and two walls."""
        points, faces = meshes.icosphere(self.subdivisions)
        return self._stage() | {
            "sphere": meshes.triangles("sphere", _RADIUS * points, faces, parts.twosided(parts.diffuse(0.5)))
        }

    def target(self) -> dict[str, Any]:
        """Return the same scene with a body in place of the sphere: the largest body with the two outlines."""
        points, faces = meshes.around(_depth, (-1.2, -1.2, -1.2), (1.2, 1.2, 1.2), 0.05)
        return self._stage() | {"body": meshes.triangles("body", points, faces, parts.twosided(parts.diffuse(0.5)))}

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("sphere.vertex_positions"),)

    def problem(self, name: str) -> Problem:
        return reconstruction(name, self)

    def _stage(self) -> dict[str, Any]:
        """Return suns, walls and cameras. Each camera is between the body and a wall, and faces the wall; each sun lights one wall only."""
        wall, half = parts.diffuse(0.7, 0.65, 0.55), 1.7
        return {
            "type": "scene",
            "camera_back": parts.camera((0, 0, -1.3), (0, 0, -_WALL), 62.0, self.resolution),
            "camera_left": parts.camera((-1.3, 0, 0), (-_WALL, 0, 0), 62.0, self.resolution),
            "sun_back": parts.sun((0, 0, 1), 1.0),
            "sun_left": parts.sun((1, 0, 0), 1.0),
            "back": parts.rectangle((0, 0, -_WALL), (half, 0, 0), (0, half, 0), wall),
            "left": parts.rectangle((-_WALL, 0, 0), (0, 0, -half), (0, half, 0), wall),
        }


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


_STATUE_RADIUS = 0.68
_FINE = 5  # subdivisions of the true mesh
_PROFILE = (
    *((-1.0, 0.0), (-0.97, 0.4), (-0.6, 0.66), (-0.38, 0.68), (-0.2, 0.34), (-0.05, 0.21)),
    *((0.1, 0.24), (0.3, 0.35), (0.55, 0.38), (0.78, 0.31), (0.95, 0.14), (1.0, 0.0)),
)
"""Heights and radii, from the foot to the crown."""


@register(name="statue", position=30)
@dataclass(frozen=True)
class Statue(fields.Rendered):
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

    def scene(self) -> dict[str, Any]:
        """Return the grey sphere under the sky and the sun."""
        grey = np.full((self.texture_resolution, 2 * self.texture_resolution, 3), 0.5, np.float32)
        return self._stage() | {
            "statue": _statue(lambda directions: _STATUE_RADIUS * directions, self.subdivisions, grey)
        }

    def target(self) -> dict[str, Any]:
        """Return the bust of veined stone."""
        return self._stage() | {"statue": _statue(_bust, _FINE, _stone(4 * self.texture_resolution))}

    def parameters(self) -> tuple[Parameter, ...]:
        return Parameter("statue.vertex_positions"), Parameter("statue.bsdf.brdf_0.reflectance.data")

    def problem(self, name: str) -> Problem:
        return reconstruction(name, self, surface_of="statue.vertex_positions")

    def _stage(self) -> dict[str, Any]:
        angles = 2 * np.pi * (np.arange(self.views) + 0.25) / self.views
        return {
            "type": "scene",
            **parts.cameras_around(angles, 3.6, (0.3, 1.8), (0, 0, 0), 34.0, self.resolution),
            "sky": {"type": "constant", "radiance": parts.colour(0.3, 0.33, 0.4)},
            "sun": parts.sun((0.6, 0.9, 0.7), 0.6),
        }


def _statue(place: Any, subdivisions: int, texture: np.ndarray) -> Any:
    directions, faces = meshes.icosphere(subdivisions)
    of, faces, coordinates = meshes.unrolled(directions, faces)
    stone = parts.twosided({"type": "diffuse", "reflectance": parts.bitmap(texture) | {"wrap_mode": "repeat"}})
    return meshes.triangles("statue", place(directions[of]), faces, stone, coordinates)


def _bust(directions: np.ndarray) -> np.ndarray:
    """Return head, neck and shoulders with a nose, from unit directions: (V, 3)."""
    from scipy.interpolate import PchipInterpolator

    x, y, z = directions.T
    height = np.arcsin(np.clip(y, -1, 1)) / (np.pi / 2)
    radius = PchipInterpolator(*np.transpose(_PROFILE))(height)
    shoulders = parts.ramp(-height, 0.0, 0.3)
    level = np.maximum(np.sqrt(np.maximum(1 - y * y, 0)), 1e-9)
    across, along = radius * x / level, radius * z / level
    nose = 0.14 * np.exp(-((x / 0.2) ** 2) - ((height - 0.38) / 0.09) ** 2) * (z > 0)
    return np.stack(
        [across, 0.95 * height, along * (1 - 0.42 * shoulders) + nose + 0.1 * parts.ramp(height, 0.0, 0.3)], -1
    )


def _stone(rows: int) -> np.ndarray:
    """Return bands and veins of two colours, (rows, 2 rows, 3) reflectance, periodic in each row."""
    u, v = np.meshgrid((np.arange(2 * rows) + 0.5) / (2 * rows), (np.arange(rows) + 0.5) / rows)
    around = 2 * np.pi * u
    veins = 0.5 + 0.5 * np.sin(3 * around + 9 * v + 1.5 * np.sin(2 * around + 14 * v))
    bands = parts.ramp(np.sin(2 * np.pi * 3.5 * v + np.sin(around)), -0.4, 0.4)
    warm, cold, dark = (np.array(c) for c in ((0.75, 0.55, 0.35), (0.35, 0.45, 0.6), (0.2, 0.14, 0.12)))
    mixed = warm + bands[..., None] * (cold - warm)
    return (mixed + 0.6 * veins[..., None] ** 4 * (dark - mixed)).astype(np.float32)
