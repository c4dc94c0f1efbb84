"""Regularisation terms that keep a mesh smooth, or its edges of equal length."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from unrender.core import checks
from unrender.core.errors import InputError
from unrender.preconditioners.mesh import MeshTopology


@dataclass(frozen=True)
class MeshRegularizer:
    """Regularisation of vertex positions x by two dimensionless terms of the loss:

        b mean_i |x_i − mean_{j ~ i} x_j|² / ℓ²  +  e (mean |x_i − x_j|² / (mean |x_i − x_j|)² − 1)

    The first term (bi-Laplacian: its gradient is L² x) is small for a smooth surface of regular triangles; ℓ is the mean edge length of
    the mesh as loaded. It shrinks a closed mesh slightly. The second term is the squared relative deviation of the edge lengths from
    their mean. Large steps (`preconditioners.LargeSteps`) smooth the path of the optimisation, whereas these terms change its minimum.
    Vertices at the same position count as one.

    Args:
        bilaplacian: b, >= 0. An L2 loss of images starts at 0.01 to 0.1, so 0.01 is large.
        edges: e, >= 0; the same scale applies.
    """

    bilaplacian: float = 0.0
    edges: float = 0.0
    _mesh: _Mesh | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        for name in ("bilaplacian", "edges"):
            checks.number("regularizer", name, getattr(self, name), above=0.0, inclusive=True)

    def on_mesh(self, positions: np.ndarray, faces: np.ndarray) -> MeshRegularizer:
        """Return the regularizer for the vertex positions (3 V,) of a mesh with initial positions (V, 3) and faces (F, 3)."""
        bound = MeshRegularizer(self.bilaplacian, self.edges)
        object.__setattr__(bound, "_mesh", _Mesh.of(positions, faces))
        return bound

    def evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the sum of both terms, and its gradient with respect to x, (3 V,). Raises `InputError` before `on_mesh`."""
        mesh = self._mesh
        if mesh is None:
            raise InputError("regularizer: no mesh is attached; call on_mesh first")
        first, i, j = mesh.first, *mesh.neighbours.T
        places = x.reshape(-1, 3).astype(np.float64)[first]
        gradient, value = np.zeros_like(places), 0.0
        if self.bilaplacian:
            total = np.zeros_like(places)
            np.add.at(total, i, places[j])
            np.add.at(total, j, places[i])
            laplacian = places - total / mesh.valence[:, None]
            factor = self.bilaplacian / (len(places) * mesh.length**2)
            value += factor * float(np.sum(laplacian * laplacian))
            shared = laplacian / mesh.valence[:, None]
            gradient += 2 * factor * laplacian
            np.add.at(gradient, i, -2 * factor * shared[j])
            np.add.at(gradient, j, -2 * factor * shared[i])
        if self.edges:
            along = places[i] - places[j]
            lengths = np.maximum(np.linalg.norm(along, axis=1), 1e-12)
            mean, square = lengths.mean(), np.mean(lengths * lengths)
            value += self.edges * float(square / mean**2 - 1)
            slope = 2 * self.edges / len(lengths) * (lengths / mean**2 - square / mean**3)
            push = (slope / lengths)[:, None] * along
            np.add.at(gradient, i, push)
            np.add.at(gradient, j, -push)
        # The gradient of a position is divided equally among its vertices.
        return value, (gradient / mesh.copies[:, None])[mesh.places].reshape(-1)


@dataclass(frozen=True, eq=False)
class _Mesh:
    """Topology that the terms need: position index of each vertex, first vertex and number of vertices of each position, edges, valence
    and mean edge length."""

    places: np.ndarray
    first: np.ndarray
    copies: np.ndarray
    neighbours: np.ndarray
    valence: np.ndarray
    length: float

    @classmethod
    def of(cls, positions: np.ndarray, faces: np.ndarray) -> _Mesh:
        topology = MeshTopology.of(positions, faces)
        if not len(topology.neighbours):
            raise InputError("its mesh has no edges")
        _, first = np.unique(topology.places, return_index=True)
        i, j = topology.neighbours.T
        valence = np.maximum(np.bincount(np.concatenate([i, j]), minlength=len(first)), 1)
        at = positions[first].astype(np.float64)
        length = float(np.linalg.norm(at[i] - at[j], axis=1).mean())
        return cls(topology.places, first, topology.copies, topology.neighbours, valence, length)
