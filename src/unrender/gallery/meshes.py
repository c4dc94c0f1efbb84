"""Meshes of gallery problems: sheets over grids, spheres, bodies around implicit surfaces, and files of the user."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.core.geometry import rotation
from unrender.core.text import in_words
from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.description import load, load_described
from unrender.scene.meshes import subdivided
from unrender.scene.surfaces import Surface


def sheet(name: str, positions: np.ndarray, bsdf: dict[str, Any], closed: bool = False) -> Any:
    """Return a smooth mesh through a grid of points.

    Args:
        positions: (rows, columns, 3); u runs from 0 to 1 along columns, v from 0 to 1 along rows. The front faces columns × rows.
        closed: whether the last column coincides with the first one (with u = 1 there).

    Returns:
        `mitsuba.Mesh` with normals and texture coordinates; an entry of a scene dictionary.
    """
    return sheets(name, [Sheet(positions, closed)], bsdf)


@dataclass(frozen=True)
class Sheet:
    """One of several sheets that form a mesh.

    Attributes:
        positions: (rows, columns, 3), as in `sheet`.
        closed: whether the last column coincides with the first one.
        origin: (u, v) of its first corner; both increase by 1 from there.
    """

    positions: np.ndarray
    closed: bool = True
    origin: tuple[float, float] = (0.0, 0.0)


def sheets(name: str, pieces: Sequence[Sheet], bsdf: dict[str, Any]) -> Any:
    """Return several sheets as one smooth `mitsuba.Mesh` with normals, so that they move as one shape. Intersecting sheets are not cut.

    Texture coordinates run from 0 to 1 on each, unless it has another origin.
    """
    positions, coordinates, normals, faces, count = [], [], [], [], 0
    for piece in pieces:
        rows, columns = piece.positions.shape[:2]
        v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
        faces.append(count + grid_faces(rows, columns))
        positions.append(piece.positions.reshape(-1, 3))
        coordinates.append(np.stack([u, v], -1).reshape(-1, 2) + np.array(piece.origin))
        normals.append(_normals(piece.positions, piece.closed).reshape(-1, 3))
        count += rows * columns
    # Explicit normals, because those of Mitsuba have a crease at the seam.
    points, corners, uv = (np.concatenate(of) for of in (positions, faces, coordinates))
    return mesh_layout.build(name, points, corners, np.concatenate(normals), uv, load_described(bsdf))


def triangles(
    name: str, positions: np.ndarray, faces: np.ndarray, bsdf: dict[str, Any], coordinates: np.ndarray | None = None
) -> Any:
    """Return a smooth `mitsuba.Mesh` of triangles, whose normals follow its vertices when these move.

    Positions are (V, 3), faces (F, 3), counter-clockwise seen from outside, and texture coordinates (V, 2) or None.
    """
    return mesh_layout.build(name, positions, faces, None, coordinates, load_described(bsdf))


def height_grid(count: int) -> np.ndarray:
    """Return the vertices (n, n, 3) of a flat height field, x and y in [-1, 1] at z = 0."""
    y, x = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count), indexing="ij")
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Return the triangles of a grid of vertices in row-major order, (2 (rows - 1) (columns - 1), 3); those of `height_grid` face +z."""
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])


def surface(mesh: Any) -> Surface:
    """Return the vertices and faces of a loaded `mitsuba.Mesh`."""
    points, faces = np.array(mesh_layout.positions(mesh)), np.array(mesh_layout.faces(mesh))
    return Surface(points.reshape(-1, 3), faces.reshape(-1, 3))


def lathe(radius: np.ndarray, height: np.ndarray, columns: int) -> np.ndarray:
    """Revolve a profile about the y axis: (rows, columns + 1, 3), closed, facing away from the axis.

    Args:
        radius, height: profile from bottom to top, (rows,).
        columns: number of steps around the axis; u = 0.5 is at +z, u = 0.75 at +x, and the seam at -z.
    """
    angle = np.linspace(-np.pi, np.pi, columns + 1)
    return np.stack(
        [
            radius[:, None] * np.sin(angle),
            np.broadcast_to(height[:, None], (len(height), columns + 1)),
            radius[:, None] * np.cos(angle),
        ],
        axis=-1,
    )


def sweep(path: np.ndarray, radius: float | np.ndarray, columns: int) -> np.ndarray:
    """Sweep a circle along a path in a plane z = constant: (rows, columns + 1, 3), closed, with open ends.

    Args:
        path: (rows, 3), with equal z; consecutive points must differ.
        radius: radius of the circle, one number or (rows,); less than the path's radius of curvature.
        columns: number of steps around the circle.
    """
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    binormal = np.array([0.0, 0.0, 1.0])
    normal = np.cross(binormal, tangent)
    angle = np.linspace(-np.pi, np.pi, columns + 1)[None, :, None]
    around = np.cos(angle) * normal[:, None] + np.sin(angle) * binormal
    return path[:, None] + np.broadcast_to(radius, len(path))[:, None, None] * around


def ellipsoid(axes: np.ndarray, centre: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return a linearly mapped sphere: (rows, columns + 1, 3), closed, facing outward.

    Args:
        axes: half-axes as columns, to which x, y and z are mapped, (3, 3), right-handed; the poles are on the second.
        centre: (3,).
        rows, columns: size of the grid, from pole to pole and around.
    """
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rows)
    # The grid ends before the poles, where a sheet has no normal.
    return lathe(np.maximum(np.cos(latitude), 1e-3), np.sin(latitude), columns) @ np.asarray(axes, float).T + centre


def icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit sphere as triangles of nearly equal size: positions (10 · 4ˢ + 2, 3) and faces (20 · 4ˢ, 3), facing outward.

    Args:
        subdivisions: s, number of subdivisions of the icosahedron.
    """
    from scipy.spatial import ConvexHull

    golden = (1 + 5**0.5) / 2
    corners = [(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    points = np.array([np.roll(corner, turn) for turn in range(3) for corner in corners], float)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices
    a, b, c = points[faces.T]
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(subdivisions):
        faces, edges = subdivided(faces, len(points))
        middles = points[edges].sum(axis=1)
        points = np.concatenate([points, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
    return points, faces


def unrolled(directions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Add texture coordinates by longitude and latitude to a sphere of triangles, cut along the seam at -z and at the poles.

    Returns the direction index of each new vertex (W,), faces (F, 3), and texture coordinates (W, 2): u increases with longitude, beyond 1
    at the seam, v with latitude.
    """
    x, y, z = directions.T
    u, v = np.arctan2(x, z) / (2 * np.pi) + 0.5, 0.5 + np.arcsin(np.clip(y, -1, 1)) / np.pi
    corners = u[faces]
    corners = np.where((np.ptp(corners, axis=1) > 0.5)[:, None] & (corners < 0.5), corners + 1, corners)
    at_pole = np.abs(y[faces]) > 1 - 1e-9
    mean_corner = np.sum(np.where(at_pole, 0, corners), axis=1) / np.maximum(np.sum(~at_pole, axis=1), 1)
    corners = np.where(at_pole, mean_corner[:, None], corners)
    table = np.concatenate([faces.reshape(-1, 1), np.round(corners.reshape(-1, 1), 9)], axis=1)
    unique, which = np.unique(table, axis=0, return_inverse=True)
    of = unique[:, 0].astype(np.int64)
    return of, which.reshape(-1, 3), np.stack([unique[:, 1], v[of]], -1)


def _normals(positions: np.ndarray, closed: bool) -> np.ndarray:
    along_rows = np.gradient(positions, axis=0)
    if closed:
        around = np.concatenate([positions[:, -2:-1], positions, positions[:, 1:2]], axis=1)
        along_columns = np.gradient(around, axis=1)[:, 1:-1]
    else:
        along_columns = np.gradient(positions, axis=1)
    normals = np.cross(along_columns, along_rows)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)


_KINDS = (".ply", ".obj")


def option(about: str) -> Any:
    """Return a dataclass field of an `Option`: the path of a PLY or OBJ file, or "" for none."""
    return field(default="", metadata={"kind": str, "about": about, "check": _check})


def standing(path: str, bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return the file as a Mitsuba dictionary: longest side 1, lowest point at y = 0, centred over the origin. Raises `InputError`."""
    low, high = _extent(path)
    scale = 1 / float(np.max(high - low))
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    return _placed(path, bsdf, scale, foot)


def centred(path: str, bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return the file as a Mitsuba dictionary: longest side 2, centre of its bounding box at the origin. Raises `InputError`."""
    low, high = _extent(path)
    return _placed(path, bsdf, 2 / float(np.max(high - low)), (low + high) / 2)


def _placed(path: str, bsdf: dict[str, Any], scale: float, origin: np.ndarray) -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().scale(scale) @ mi.ScalarTransform4f().translate((-origin).tolist())
    return {"type": _kind(path), "filename": path, "to_world": to_world, "bsdf": bsdf}


def _extent(path: str) -> tuple[np.ndarray, np.ndarray]:
    try:
        box = load({"type": _kind(path), "filename": path}).bbox()
    except Exception as error:
        reason = " ".join(str(error).split()).removeprefix(f"{path}: ")[:300]
        raise InputError(f"mesh {path}: Mitsuba could not read it: {reason}") from error
    low, high = (np.array(corner, float).reshape(3) for corner in (box.min, box.max))
    if not np.isfinite([low, high]).all() or np.max(high - low) <= 0:
        raise InputError(f"mesh {path}: expected vertices with some extent, got none")
    return low, high


def _kind(path: str) -> str:
    return Path(path).suffix.lower().removeprefix(".")


def _check(owner: str, name: str, value: Any) -> str:
    if not isinstance(value, (str, Path)):
        raise InputError(f"{owner}: {name} must be the path of a {' or '.join(_KINDS)} file, got {in_words(value)}")
    if value == "":
        return ""
    if Path(value).suffix.lower() not in _KINDS:
        raise InputError(f"{owner}: {name} must be the path of a {' or '.join(_KINDS)} file, got {str(value)!r}")
    if not Path(value).is_file():
        raise InputError(f"{owner}: {name}: {value}: no such file")
    return str(value)


@dataclass(frozen=True)
class Ellipsoid:
    """A part of a body: centre, radii along x, y and z before the tilt, and that rotation about z in degrees."""

    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    tilt: float = 0.0

    @property
    def axes(self) -> np.ndarray:
        """Half-axes as columns, (3, 3)."""
        return rotation((0, 0, 1), np.radians(self.tilt)) * np.array(self.radii)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Return the depth of points (N, 3), (N,): positive inside, approximately the distance near the surface."""
        local = (points - np.array(self.centre)) @ np.linalg.inv(self.axes).T
        length = np.linalg.norm(local, axis=1)
        slope = np.linalg.norm(local @ np.linalg.inv(self.axes), axis=1) / np.maximum(length, 1e-9)
        return (1.0 - length) / np.maximum(slope, 1e-9)


def united(parts: Sequence[Ellipsoid], blend: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return the depth function of the union of parts, a log-sum-exp that rounds their joints over the length `blend`."""

    def depth(points: np.ndarray) -> np.ndarray:
        return blend * np.logaddexp.reduce([part.depth(points) / blend for part in parts])

    return depth


def around(
    depth: Callable[[np.ndarray], np.ndarray], low: Sequence[float], high: Sequence[float], spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh where a depth is 0, by marching cubes in a box: positions (V, 3) and faces (F, 3), facing outward.

    `depth` is a function of points (N, 3), positive inside; negative on the sides of the box.
    """
    from skimage import measure

    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    values = np.clip(depth(grid.reshape(-1, 3)), -3 * spacing, 3 * spacing).reshape(grid.shape[:3])
    points, faces, _, _ = measure.marching_cubes(values, 0.0, gradient_direction="ascent")
    return points * spacing + np.asarray(low, float), faces.astype(np.int64)
