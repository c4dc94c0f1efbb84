"""Triangle meshes as surfaces: distances independent of vertices; folds; self-intersections; limits of steps against these."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.core.geometry import weld

_SAMPLES = 2000  # number of sample points on each surface
_NEAR = 8  # number of candidates for the nearest triangle
_SHARP = -0.5  # cosine of the angle between the normals of two adjacent faces below which the surface folds


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3), finite.
        faces: (F, 3), vertex indices; at least one face has positive area.

    Raises:
        InputError: invalid shapes, indices or values.
    """

    vertices: np.ndarray
    faces: np.ndarray

    def __post_init__(self):
        vertices, faces = np.asarray(self.vertices, np.float64), np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or not np.isfinite(vertices).all():
            raise InputError(f"surface: expected finite vertices of shape (V, 3), got shape {vertices.shape}")
        integral = np.issubdtype(faces.dtype, np.integer) or (faces.size and np.array_equal(faces, np.round(faces)))
        if faces.ndim != 2 or faces.shape[1:] != (3,) or not len(faces) or not integral:
            raise InputError(f"surface: expected vertex indices (integers) of shape (F, 3), got shape {faces.shape}")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(f"surface: a face names vertex {int(faces.max())} of {len(vertices)}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces.astype(np.int64))
        if not self._areas.sum() > 0:
            raise InputError("surface: none of its faces has an area")

    @cached_property
    def _areas(self) -> np.ndarray:
        return np.linalg.norm(area_normals(self.vertices, self.faces), axis=1)

    @cached_property
    def _samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Sample points uniform by area, and the index of each one's face; the same at each call."""
        generator = np.random.default_rng(0)
        up_to = np.cumsum(self._areas)
        at = (np.arange(_SAMPLES) + generator.uniform(size=_SAMPLES)) / _SAMPLES * up_to[-1]
        face = np.minimum(np.searchsorted(up_to, at, side="right"), len(self.faces) - 1)
        root, second = np.sqrt(generator.uniform(size=_SAMPLES)), generator.uniform(size=_SAMPLES)
        weights = np.stack([1 - root, root * (1 - second), root * second], -1)
        points = np.einsum("ni,nij->nj", weights, self.vertices[self.faces[face]])
        return points, face

    @cached_property
    def _tree(self) -> tuple[Any, np.ndarray]:
        """Search tree of the sample points and the centroids of all faces, and the face index of each."""
        from scipy.spatial import KDTree

        points, face = self._samples
        middles = self.vertices[self.faces].mean(axis=1)
        return KDTree(np.concatenate([points, middles])), np.concatenate([face, np.arange(len(self.faces))])

    def distances_from(self, other: Surface) -> np.ndarray:
        """Return the distances (2000,) from points uniform by area on another surface to this one. Deterministic.

        Distances are exact for the triangles of the nearest sample points and centroids, hence never too small.
        """
        points, (tree, face) = other._samples[0], self._tree
        near = face[tree.query(points, k=_NEAR)[1]]
        many = np.repeat(points, _NEAR, axis=0)
        distances = np.linalg.norm(many - _nearest(many, self.vertices[self.faces[near.ravel()]]), axis=1)
        return distances.reshape(-1, _NEAR).min(axis=1)


def surface_error(one: Surface, other: Surface) -> float:
    """Return the root mean square distance between two surfaces, in units of the scene.

    It is the distance of points uniform by area on each surface to the other: the root of half the symmetric squared Chamfer distance. 0
    for equal surfaces with different triangles.
    """
    squares = [np.mean(np.square(a.distances_from(b))) for a, b in ((one, other), (other, one))]
    return float(np.sqrt(np.mean(squares)))


def area_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the normal of each face times twice its area, (F, 3); 0 for a degenerate face."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def folds(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Return the number of edges whose two faces are rotated by more than 120 degrees relative to each other. Vertices (V, 3) split along
    seams must be merged in the faces (F, 3), or their edges count as borders."""
    normals = area_normals(vertices, faces)
    length = np.linalg.norm(normals, axis=1)
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((*np.sort(sides, axis=1).T,))
    ordered, owner = np.sort(sides, axis=1)[order], owner[order]
    pair = (ordered[1:] == ordered[:-1]).all(axis=1)
    one, two = owner[:-1][pair], owner[1:][pair]
    counted = (length[one] > 0) & (length[two] > 0)
    cosine = np.sum(normals[one] * normals[two], axis=1)[counted] / (length[one] * length[two])[counted]
    return int(np.sum(cosine < _SHARP))


def _nearest(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the point of each triangle (N, 3, 3) nearest to a point (N, 3): its projection if inside, else the nearest edge point."""
    a, b, c = triangles.transpose(1, 0, 2)
    best = np.full(points.shape, np.inf)
    least = np.full(len(points), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        t = np.sum((points - start) * along, axis=1) / np.maximum(np.sum(along * along, axis=1), 1e-300)
        candidate = start + np.clip(t, 0, 1)[:, None] * along
        distance = np.sum(np.square(points - candidate), axis=1)
        best = np.where((distance < least)[:, None], candidate, best)
        least = np.minimum(least, distance)
    normal = np.cross(b - a, c - a)
    square = np.maximum(np.sum(normal * normal, axis=1), 1e-300)
    projected = points - (np.sum((points - a) * normal, axis=1) / square)[:, None] * normal
    inside = np.ones(len(points), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= np.sum(np.cross(end - start, projected - start) * normal, axis=1) >= 0
    return np.where((inside & (square > 1e-290))[:, None], projected, best)


_CELLS_PER_TRIANGLE = 8  # maximum average number of grid cells per triangle: cells grow until it holds


def crossing_triangles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return pairs of triangles (N, 2), the lower one first, sorted, where an edge of one passes through the interior of the other.

    Excluded are triangles that only touch, that lie in one plane, or that share an edge (these can only fold: `surfaces.folds`). Triangles
    that share one vertex count if the opposite edge passes through the other triangle. Vertices split along seams must be merged.
    """
    if len(faces) < 2:
        return np.zeros((0, 2), int)
    corners = np.asarray(vertices, np.float64)[faces]
    pairs = _near(corners.min(axis=1), corners.max(axis=1))
    shared = (faces[pairs[:, 0], :, None] == faces[pairs[:, 1], None, :]).any(axis=2).sum(axis=1)
    pairs = pairs[shared < 2]
    crossed = np.zeros(len(pairs), bool)
    for one, two in ((0, 1), (1, 0)):
        triangle, other = pairs[:, one], pairs[:, two]
        for start, end in ((0, 1), (1, 2), (2, 0)):
            ends = faces[other][:, [start, end]]
            apart = ~(ends[:, :, None] == faces[triangle][:, None, :]).any(axis=(1, 2))
            chosen = np.flatnonzero(apart & ~crossed)
            p, q = corners[other[chosen], start], corners[other[chosen], end]
            crossed[chosen] = _passes(p, q, corners[triangle[chosen]])
    return pairs[crossed]


def _passes(p: np.ndarray, q: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return whether segments from p to q (N, 3) pass through the interiors of triangles (N, 3, 3), by the signs of volumes."""
    a, b, c = triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    before, after = np.sum((p - a) * normal, axis=1), np.sum((q - a) * normal, axis=1)
    along = q - p
    sides = np.stack(
        [np.sum(along * np.cross(start - p, end - p), axis=1) for start, end in ((a, b), (b, c), (c, a))], -1
    )
    inside = (sides > 0).all(axis=1) | (sides < 0).all(axis=1)
    return inside & (before * after < 0)


def _near(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return pairs (N, 2) of overlapping boxes by a uniform grid, the lower index first, sorted."""
    count, origin = len(low), low.min(axis=0)
    size = max(2.0 * float(np.median((high - low).max(axis=1))), 1e-30)
    while True:
        first, last = (np.floor((x - origin) / size).astype(np.int64) for x in (low, high))
        spans = last - first + 1
        cells = spans.prod(axis=1)
        if cells.sum() <= _CELLS_PER_TRIANGLE * count:
            break
        size *= 2.0
    owner = np.repeat(np.arange(count), cells)
    offset = np.arange(len(owner)) - np.repeat(np.cumsum(cells) - cells, cells)
    span = spans[owner]
    place = np.stack([offset % span[:, 0], offset // span[:, 0] % span[:, 1], offset // (span[:, 0] * span[:, 1])], -1)
    place += first[owner]
    extent = last.max(axis=0) + 1
    cell = (place[:, 2] * extent[1] + place[:, 1]) * extent[0] + place[:, 0]
    order = np.argsort(cell, kind="stable")
    cell, owner = cell[order], owner[order]
    overlapping = []
    for step in range(1, count):
        same = np.flatnonzero(cell[step:] == cell[:-step])
        if not len(same):
            break
        one, two = owner[same], owner[same + step]
        overlap = ((low[one] <= high[two]) & (low[two] <= high[one])).all(axis=1)
        overlapping.append(one[overlap] * count + two[overlap])
    return np.stack(np.divmod(np.unique(np.concatenate(overlapping or [np.zeros(0, int)])), count), -1)


_HALVINGS = 3
_LEAST_AREA = 0.01
"""Smallest projected area of a triangle along its previous normal, relative to its previous area; below it, it counts as turned over."""


def guarded(before: np.ndarray, after: np.ndarray, faces: np.ndarray, crossing: bool = True) -> np.ndarray:
    """Return vertex positions (3 V,) between `before` and `after` at which no triangle has turned over; `after` itself if possible.

    The step is halved up to three times. Vertices of triangles that would still turn over do not move. Degenerate triangles are ignored.
    Without `crossing`, new intersections count as turned over.
    """
    start, end = before.reshape(-1, 3).astype(np.float64), after.reshape(-1, 3).astype(np.float64)
    normals = area_normals(start, faces)
    least = _LEAST_AREA * np.sum(normals * normals, axis=1)

    joined = faces if crossing else _joined(start, faces)
    known = np.zeros((0, 2), int) if crossing else crossing_triangles(start, joined)

    def turned(vertices: np.ndarray) -> np.ndarray:
        over_mask = np.sum(normals * area_normals(vertices, faces), axis=1) < least
        if not crossing:
            pairs = crossing_triangles(vertices, joined)
            new = ~np.isin(pairs @ [len(faces), 1], known @ [len(faces), 1])
            over_mask[pairs[new].reshape(-1)] = True
        return over_mask

    if not turned(end).any():
        return after
    for halving in range(1, _HALVINGS + 1):
        vertices = start + (end - start) * 0.5**halving
        if not turned(vertices).any():
            return vertices.reshape(-1).astype(after.dtype)
    stays, (_, places) = np.zeros(len(start), bool), weld(start)
    while (over := turned(vertices) & ~stays[faces].all(axis=1)).any():
        stays[faces[over]] = True
        stays |= np.bincount(places, weights=stays)[places] > 0  # with others at their positions, as on seams
        vertices = np.where(stays[:, None], start, vertices)
    return vertices.reshape(-1).astype(after.dtype)


def _joined(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return faces with each vertex replaced by the first vertex at its position."""
    first, places = weld(vertices)
    return first[places][faces]
