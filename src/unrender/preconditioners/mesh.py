"""Solvers of (C + λ L) y = x on a mesh with graph Laplacian L and vertex multiplicities C, and powers of their inverse.

A *place* is a set of vertices that move together. C is the diagonal matrix of their numbers. (L x)_i is the sum of x_i − x_j over the
places j that share an edge with place i. For positions, vertices at the same position form one place, so that both sides of a seam of
texture coordinates or normals move together. For attributes such as colours, each vertex is its own place, and both sides of a seam are
neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from unrender.core.errors import InputError
from unrender.core.geometry import weld

if TYPE_CHECKING:
    import scipy.sparse

_POLE_FACTOR = 16.0
"""Ratio of successive λ_k of the solvers whose sum approximates a function of L.

A ratio of 4 has smaller errors and needs twice as many solvers.
"""
_WEAKEST_POLE = 1 / 16
_SAMPLES = 200  # number of points of the spectrum of L at which such a sum is fitted


@dataclass(frozen=True, eq=False)
class MeshTopology:
    """Groups of coincident vertices of a mesh (places), and the edges between them.

    Attributes:
        places: index of each vertex's place, (V,).
        neighbours: pairs of places that share an edge, each once, (E, 2).
    """

    places: np.ndarray
    neighbours: np.ndarray
    _solvers: dict[float, MeshSolver] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, positions: np.ndarray, faces: np.ndarray, welded: bool = True) -> MeshTopology:
        """Build the topology of a mesh, (V, 3) and (F, 3). Vertices at the same position are one place if `welded`, else neighbours."""
        _, places = weld(positions)
        if welded:
            return cls(places, _pairs(_edges(places[faces])))
        order = np.argsort(places, kind="stable")
        cut = places[order[:-1]] == places[order[1:]]
        links = np.stack([order[:-1][cut], order[1:][cut]], axis=1)
        return cls(np.arange(len(places)), _pairs(np.concatenate([_edges(faces), links])))

    @cached_property
    def copies(self) -> np.ndarray:
        """Diagonal of C, (P,): number of vertices at each place."""
        return np.bincount(self.places)

    @cached_property
    def laplacian(self) -> scipy.sparse.csr_matrix:
        """Graph Laplacian L, (P, P)."""
        import scipy.sparse

        i, j = self.neighbours.T
        edges = scipy.sparse.coo_matrix((np.ones(len(i)), (i, j)), (len(self.copies),) * 2)
        adjacency = edges + edges.T
        return (scipy.sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency).tocsr()

    def solver(self, strength: float) -> MeshSolver:
        """Return the cached solver of (C + λ L) y = x."""
        if strength not in self._solvers:
            self._solvers[strength] = MeshSolver(strength, self)
        return self._solvers[strength]

    def gathered(self, x: np.ndarray) -> np.ndarray:
        """Return Bᵀ x, (P, n) float64: sums over the vertices of each place, for x (V, n)."""
        sums = (np.bincount(self.places, column, len(self.copies)) for column in x.T)
        return np.stack(list(sums), axis=1)

    def split(self, owner: str, x: np.ndarray) -> np.ndarray:
        """Reshape vertex values (n V,) to (V, n). Raises `InputError` for another number of vertices."""
        vertices = len(self.places)
        if x.ndim != 1 or x.size == 0 or x.size % vertices:
            raise InputError(f"{owner}: expected values of the mesh's {vertices} vertices, got shape {x.shape}")
        return x.reshape(vertices, -1)


class MeshSolver:
    """B (C + λ L)^-1 Bᵀ by a sparse Cholesky factorisation that is computed once.

    B copies the value of a place to its vertices, Bᵀ sums over them, and C = Bᵀ B. Constants are preserved whatever the seams; without
    seams C is I.

    Args:
        strength: λ, >= 0.
    """

    def __init__(self, strength: float, topology: MeshTopology):
        self._strength, self._topology = strength, topology

    @cached_property
    def _factor(self):
        import scipy.sparse
        from cholespy import CholeskySolverF, MatrixType  # type: ignore  (a compiled module without stubs)

        copies = scipy.sparse.diags(self._topology.copies.astype(float))
        matrix = (copies + self._strength * self._topology.laplacian).tocoo()
        rows, columns = matrix.row.astype(np.int32), matrix.col.astype(np.int32)
        return CholeskySolverF(matrix.shape[0], rows, columns, matrix.data.astype(np.float64), MatrixType.COO)

    def solve(self, x: np.ndarray) -> np.ndarray:
        """Return B (C + λ L)^-1 Bᵀ x, (n V,) float32, for each of n channels. Raises `InputError` for another number of vertices."""
        values = self._topology.split("LargeSteps", np.asarray(x, np.float32))
        return self.solve_places(self._topology.gathered(values))[self._topology.places].reshape(-1)

    def solve_places(self, x: np.ndarray) -> np.ndarray:
        """Return (C + λ L)^-1 x, (P, n), float32."""
        right = np.ascontiguousarray(x, np.float32)
        result = np.empty_like(right)
        self._factor.solve(right, result)
        return result


class MeshSpectrum:
    """Approximation of functions of C^-1/2 L C^-1/2 by sums of solvers, C^1/2 Σ_k w_k (C + λ_k L)^-1 C^1/2 with w_k >= 0.

    It applies to functions that are such integrals with positive weights, among them (1 + λ x)^-1 and its square root for every λ up to
    the strongest. The λ_k are 0 and the strongest divided by powers of 16. Non-negative least squares over the spectrum fits the weights
    to an error of a few percent. The sum is symmetric and positive definite, as a preconditioner must be, and preserves constants.

    Args:
        strongest: largest λ, >= 0.

    Attributes:
        topology: as above.
    """

    def __init__(self, topology: MeshTopology, strongest: float):
        self.topology = topology
        strongest = max(strongest, _WEAKEST_POLE)
        count = 1 + math.ceil(math.log(strongest / _WEAKEST_POLE, _POLE_FACTOR))
        self._poles = (0.0, *(strongest * _POLE_FACTOR ** -np.arange(count, dtype=float)))
        self._largest = max(1.0, 2.0 * float((topology.laplacian.diagonal() / topology.copies).max(initial=0.0)))
        self._weights: dict[tuple[float, float], np.ndarray] = {}

    def solved(self, x: np.ndarray) -> np.ndarray:
        """Return (C + λ_k L)^-1 x for all poles, (poles, P, n), for x (P, n)."""
        return np.stack(
            [
                x / self.topology.copies[:, None],
                *(self.topology.solver(pole).solve_places(x) for pole in self._poles[1:]),
            ]
        )

    def weights(self, strength: float, power: float) -> np.ndarray:
        """Return the weights w >= 0, (poles,), with sum 1, that fit (1 + λ x)^-power; λ up to the strongest, power up to 1."""
        from scipy.optimize import nnls

        if (strength, power) not in self._weights:
            x = np.geomspace(1e-3 / self._poles[1], self._largest, _SAMPLES)
            basis = 1.0 / (1.0 + np.outer(x, self._poles))
            weights, _ = nnls(basis * ((1.0 + strength * x) ** power)[:, None], np.ones(len(x)))
            self._weights[strength, power] = weights / weights.sum()
        return self._weights[strength, power]

    def root(self, strength: float, x: np.ndarray) -> np.ndarray:
        """Return an approximation of B C^-1/2 (I + λ C^-1/2 L C^-1/2)^-1/2 C^-1/2 Bᵀ x, with the shape of x, (V, n) float32."""
        values = np.tensordot(self.weights(strength, 0.5), self.solved(self.topology.gathered(x)), 1)
        return np.asarray(values[self.topology.places], np.float32)

    def descents(self, strength: float, smooth: np.ndarray, gradient: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """Return the products of `Sobolev.descents`; smooth, gradient: (V, n)."""
        topology = self.topology
        places = np.zeros((len(topology.copies), smooth.shape[1]))
        places[topology.places] = self.root(strength, smooth)  # (C + λ L)^-1 Bᵀ g
        first = topology.copies[:, None] * places + strength * (topology.laplacian @ places)
        second, solved = topology.gathered(gradient), self.solved(first)
        sums = np.einsum("kpn,spn->sk", solved, np.stack([second, first]))
        return sums @ np.transpose([self.weights(share * strength, 1.0) for share in shares])


def _edges(corners: np.ndarray) -> np.ndarray:
    return np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])


def _pairs(edges: np.ndarray) -> np.ndarray:
    pairs = np.sort(edges, axis=1)
    return np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
