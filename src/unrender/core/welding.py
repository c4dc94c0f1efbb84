"""Vertices of a mesh at the same position, such as those on both sides of a seam of texture coordinates."""

from __future__ import annotations

import numpy as np

_ROUNDING = 1e-6
"""Distance of coincident points relative to the largest coordinate: some rounding errors in single precision."""


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

    i, j = KDTree(different).query_pairs(_ROUNDING * np.abs(different).max(), output_type="ndarray").T
    if not len(i):
        return first, places
    _, joined = connected_components(coo_matrix((np.ones(len(i)), (i, j)), (len(first),) * 2), directed=False)
    _, kept = np.unique(joined, return_index=True)
    return first[kept], joined[places]
