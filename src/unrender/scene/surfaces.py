"""How far two triangle meshes are from one another as surfaces, whatever their vertices are; and where a mesh folds over."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from unrender.core.errors import InputError

__all__ = ["Surface", "area_normals", "folds", "surface_error"]

_SAMPLES = 2000
"""Points on each surface."""
_NEAR = 8
"""Candidates for the nearest triangle."""
_SHARP = -0.5
"""Cosine of the angle between the normals of two faces that share an edge, below which the surface folds over there."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3), finite.
        faces: (F, 3), numbers of vertices, at least one face of some area.

    Raises:
        InputError: shapes, numbers or values do not suit.
    """

    vertices: np.ndarray
    faces: np.ndarray

    def __post_init__(self):
        vertices, faces = np.asarray(self.vertices, np.float64), np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or not np.isfinite(vertices).all():
            raise InputError(f"surface: expected finite vertices of shape (V, 3), got shape {vertices.shape}")
        whole = np.issubdtype(faces.dtype, np.integer) or (faces.size and np.array_equal(faces, np.round(faces)))
        if faces.ndim != 2 or faces.shape[1:] != (3,) or not len(faces) or not whole:
            raise InputError(f"surface: expected whole numbers of vertices of shape (F, 3), got shape {faces.shape}")
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
        """Points, even by area, and the faces that they lie on; the same at each call."""
        generator = np.random.default_rng(0)
        up_to = np.cumsum(self._areas)
        at = (np.arange(_SAMPLES) + generator.uniform(size=_SAMPLES)) / _SAMPLES * up_to[-1]
        of = np.minimum(np.searchsorted(up_to, at, side="right"), len(self.faces) - 1)
        root, second = np.sqrt(generator.uniform(size=_SAMPLES)), generator.uniform(size=_SAMPLES)
        weights = np.stack([1 - root, root * (1 - second), root * second], -1)
        points = np.einsum("ni,nij->nj", weights, self.vertices[self.faces[of]])
        return points, of

    @cached_property
    def _tree(self) -> tuple[Any, np.ndarray]:
        """Of the points and of the middles of all faces, and which face each belongs to."""
        from scipy.spatial import KDTree

        points, of = self._samples
        middles = self.vertices[self.faces].mean(axis=1)
        return KDTree(np.concatenate([points, middles])), np.concatenate([of, np.arange(len(self.faces))])

    def distances_from(self, other: Surface) -> np.ndarray:
        """Of points on another surface, even by area, to this one: (N,), exact to the triangles of this one's points that are nearest,
        hence never too small."""
        points, (tree, of) = other._samples[0], self._tree
        near = of[tree.query(points, k=_NEAR)[1]]
        many = np.repeat(points, _NEAR, axis=0)
        found = np.linalg.norm(many - _nearest(many, self.vertices[self.faces[near.ravel()]]), axis=1)
        return found.reshape(-1, _NEAR).min(axis=1)


def surface_error(one: Surface, other: Surface) -> float:
    """Root mean square distance between two surfaces, in units of the scene: of points of each, even by area, to the other one (the root
    of the symmetric Chamfer distance of squares, halved). 0 for the same surface, whatever its triangles are."""
    squares = [np.mean(np.square(a.distances_from(b))) for a, b in ((one, other), (other, one))]
    return float(np.sqrt(np.mean(squares)))


def area_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of each face, (F, 3): its normal times twice its area; 0 where it has none."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def folds(vertices: np.ndarray, faces: np.ndarray) -> int:
    """How many edges between two faces have these turned by more than 120 degrees against each other.

    Args:
        vertices: (V, 3).
        faces: (F, 3), numbers of places: vertices cut along seams count as one, or their edges as borders.
    """
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
    """The point of each triangle (N, 3, 3) that is nearest to a point (N, 3): inside where its projection is, else on an edge."""
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
