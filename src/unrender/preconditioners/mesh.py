"""The solver of (C + λ L) y = x over the places of a mesh, L its graph Laplacian, C how many vertices are there.

(L x)_i is the sum of x_i − x_j over the vertices j that an edge joins with vertex i. Vertices at the same place are one: what is cut along
seams of texture coordinates or of normals moves together.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from unrender.core.errors import InputError

__all__ = ["MeshSolver", "MeshTopology"]


@dataclass(frozen=True, eq=False)
class MeshTopology:
    """Which vertices of a mesh are one, and which are neighbours.

    Attributes:
        places: of each vertex, the number of its place, (V,).
        neighbours: pairs of places that an edge joins, each once, (E, 2).
    """

    places: np.ndarray
    neighbours: np.ndarray

    @classmethod
    def of(cls, positions: np.ndarray, faces: np.ndarray) -> MeshTopology:
        """Of a mesh as loaded: positions (V, 3), faces (F, 3)."""
        _, places = np.unique(positions, axis=0, return_inverse=True)
        places = places.reshape(-1)
        corners = places[faces]
        pairs = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
        return cls(places, np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0))


class MeshSolver:
    """B (C + λ L)^-1 Bᵀ by sparse Cholesky factorisation, once: B hands what a place has to its vertices, Bᵀ sums them up, C = Bᵀ B.

    So a constant passes unchanged, whatever vertices are cut; where none is, C is I.

    Args:
        strength: λ, >= 0.
        topology: of the mesh.
    """

    def __init__(self, strength: float, topology: MeshTopology):
        self._strength, self._topology = strength, topology
        self._copies = np.bincount(topology.places)
        self._count = len(self._copies)

    @cached_property
    def _factor(self):
        import scipy.sparse
        from cholespy import CholeskySolverF, MatrixType  # type: ignore  (a compiled module without stubs)

        i, j = self._topology.neighbours.T
        edges = scipy.sparse.coo_matrix((np.ones(len(i)), (i, j)), (self._count, self._count))
        adjacency = edges + edges.T
        laplacian = scipy.sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
        matrix = (scipy.sparse.diags(self._copies.astype(float)) + self._strength * laplacian).tocoo()
        rows, columns = matrix.row.astype(np.int32), matrix.col.astype(np.int32)
        return CholeskySolverF(self._count, rows, columns, matrix.data.astype(np.float64), MatrixType.COO)

    def solve(self, x: np.ndarray) -> np.ndarray:
        """y of the shape of x, (3 V,) float32, each coordinate by itself. Raises `InputError` for another number of vertices."""
        places = self._topology.places
        if x.shape != (3 * len(places),):
            raise InputError(f"LargeSteps: expected the {3 * len(places)} coordinates of the mesh, got shape {x.shape}")
        right = np.zeros((self._count, 3), np.float32)
        np.add.at(right, places, np.asarray(x, np.float32).reshape(-1, 3))
        result = np.empty_like(right)
        self._factor.solve(right, result)
        return result[places].reshape(-1)
