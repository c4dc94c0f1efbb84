"""Steps of meshes that keep triangles from turning over and, where asked for, from passing through one another."""

from __future__ import annotations

import numpy as np

from unrender.scene.self_intersections import crossing_triangles
from unrender.scene.surfaces import area_normals

_HALVINGS = 3
_LEAST_AREA = 0.01
"""Of a triangle's area, as seen from where its normal pointed before, below which it counts as turned over."""


def guarded(before: np.ndarray, after: np.ndarray, faces: np.ndarray, crossing: bool = True) -> np.ndarray:
    """Vertex positions (3 V,) on the way from `before` to `after` at which no triangle has turned over; `after` itself where none does.

    The whole step is halved up to three times; where triangles still turn over, their vertices stay where they were. Triangles without area
    before do not count.

    Args:
        before, after: vertex positions, (3 V,).
        faces: (F, 3).
        crossing: whether triangles may pass through one another; if not, those that would, and did not before, count as turned over.
    """
    start, end = before.reshape(-1, 3).astype(np.float64), after.reshape(-1, 3).astype(np.float64)
    normals = area_normals(start, faces)
    least = _LEAST_AREA * np.sum(normals * normals, axis=1)

    joined = faces if crossing else _joined(start, faces)
    known = np.zeros((0, 2), int) if crossing else crossing_triangles(start, joined)

    def turned(vertices: np.ndarray) -> np.ndarray:
        found = np.sum(normals * area_normals(vertices, faces), axis=1) < least
        if not crossing:
            pairs = crossing_triangles(vertices, joined)
            new = ~np.isin(pairs @ [len(faces), 1], known @ [len(faces), 1])
            found[pairs[new].reshape(-1)] = True
        return found

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
    """Faces by the first of all vertices at each place."""
    _, first, places = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    return first[places.reshape(-1)][faces]


def _at_same_place(chosen: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """The chosen vertices (V,) and all others at their places, as along seams; `chosen` becomes that."""
    _, places = np.unique(vertices, axis=0, return_inverse=True)
    places = places.reshape(-1)
    chosen |= np.bincount(places, weights=chosen)[places] > 0
    return chosen
