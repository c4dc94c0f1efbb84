"""Limitation of mesh steps, to prevent triangles from turning over and, optionally, from intersecting."""

from __future__ import annotations

import numpy as np

from unrender.scene.surfaces import area_normals, crossing_triangles

_HALVINGS = 3
_LEAST_AREA = 0.01
"""Smallest projected area of a triangle along its previous normal, relative to its previous area; below it, it counts as turned over."""


def guarded(before: np.ndarray, after: np.ndarray, faces: np.ndarray, crossing: bool = True) -> np.ndarray:
    """Return vertex positions (3 V,) between `before` and `after` at which no triangle has turned over; `after` itself if possible.

    The step is halved up to three times. Vertices of triangles that would still turn over do not move. Degenerate triangles are ignored.

    Args:
        before, after: vertex positions, (3 V,).
        faces: vertex indices, (F, 3).
        crossing: whether triangles may intersect; if not, new intersections count as turned over.
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
    stays = np.zeros(len(start), bool)
    while (over := turned(vertices) & ~stays[faces].all(axis=1)).any():
        stays[faces[over]] = True
        vertices = np.where(_at_same_place(stays, start)[:, None], start, vertices)
    return vertices.reshape(-1).astype(after.dtype)


def _joined(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return faces with each vertex replaced by the first vertex at its position."""
    _, first, places = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    return first[places.reshape(-1)][faces]


def _at_same_place(chosen: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Extend the chosen vertices (V,) by all others at their positions, as on both sides of seams. Modifies `chosen`."""
    _, places = np.unique(vertices, axis=0, return_inverse=True)
    places = places.reshape(-1)
    chosen |= np.bincount(places, weights=chosen)[places] > 0
    return chosen
