"""Vertices at the same position, rotation matrices, and conversion of camera axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_OF_SIZE, _OF_COORDINATE, _OF_NEIGHBOURS = 1e-6, 1.5e-7, 0.01
"""Largest distance of coincident points: parts of the size and of the largest coordinate, which are rounding errors in single precision,
and of the usual distance of neighbours, which details are not below."""
_SAMPLE = 4096  # number of points whose neighbours are looked at


def weld(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the first point of each position, (P,), and each point's position, (V,), for points (V, 3).

    Positions are equal up to rounding: a seam that a program computes, as at the angles 0 and 2π, differs in the last digits.
    """
    _, first, places = np.unique(points, axis=0, return_index=True, return_inverse=True)
    places, different = places.reshape(-1), np.asarray(points, np.float64)[first]
    if not np.isfinite(different).all() or len(different) < 2:
        return first, places
    from scipy.sparse import coo_matrix  # both take long to import
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    tree = KDTree(different)
    rounding = _OF_SIZE * np.ptp(different, axis=0).max() + _OF_COORDINATE * np.abs(different).max()
    usual = float(np.median(tree.query(different[:: len(different) // _SAMPLE + 1], k=2)[0][:, 1]))
    i, j = tree.query_pairs(min(rounding, _OF_NEIGHBOURS * usual), output_type="ndarray").T
    if not len(i):
        return first, places
    _, joined = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (len(first),) * 2), directed=False)
    _, kept = np.unique(joined, return_index=True)
    return first[kept], joined[places]


MITSUBA_TO_OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Right factor that converts a camera-to-world matrix (4, 4) from one convention to the other. It is its own inverse."""
MITSUBA_TO_OPENGL.setflags(write=False)


def shortest_rotation(axis: Sequence[float], end: np.ndarray) -> np.ndarray:
    """Return the shortest rotation (3, 3) from a coordinate axis to a unit vector, as a product of two half turns."""
    start = np.asarray(axis, float)
    middle = start + end
    length = float(np.linalg.norm(middle))
    middle = middle / length if length > 5e-5 else np.roll(start, 1)
    return (2 * np.outer(middle, middle) - np.eye(3)) @ (2 * np.outer(start, start) - np.eye(3))


def rotation(axis: Sequence[float] | np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) of column vectors, counterclockwise by radians seen from the tip of a unit axis (Rodrigues'
    formula)."""
    x, y, z = np.asarray(axis, float)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    cosine, sine = np.cos(angle), np.sin(angle)
    return cosine * np.eye(3) + sine * cross + (1 - cosine) * np.outer((x, y, z), (x, y, z))
