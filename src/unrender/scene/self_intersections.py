"""Detection of self-intersections of a triangle mesh."""

from __future__ import annotations

import numpy as np

_CELLS_PER_TRIANGLE = 8
"""Maximum average number of grid cells per triangle: cells grow until it holds."""


def crossing_triangles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return pairs of triangles where an edge of one passes through the interior of the other.

    Excluded are triangles that only touch, that lie in one plane, or that share an edge (these can only fold: `surfaces.folds`).
    Triangles that share one vertex count if the opposite edge passes through the other triangle.

    Args:
        vertices: (V, 3).
        faces: (F, 3), position indices: vertices split along seams must be merged, or their triangles count as unconnected.

    Returns:
        Face indices, (N, 2), the lower one first, sorted.
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
        overlapping.append(np.stack([one, two], -1)[overlap])
    return np.unique(np.concatenate(overlapping), axis=0) if overlapping else np.zeros((0, 2), int)
