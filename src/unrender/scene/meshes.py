"""Settings for meshes among a problem's parameters: regularisation, remeshing, and their validation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from unrender.core import checks, tables
from unrender.core.checks import NotNegative, Positive
from unrender.core.errors import InputError
from unrender.core.geometry import weld
from unrender.core.text import did_you_mean, in_words
from unrender.io.toml_lines import FieldError
from unrender.preconditioners.mesh import MeshTopology
from unrender.rendering.renderer import ReplacedMesh
from unrender.scene.coarse_to_fine import checked_steps
from unrender.scene.surfaces import Surface, area_normals


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

    bilaplacian: NotNegative = 0.0
    edges: NotNegative = 0.0
    _mesh: _Mesh | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        checks.fields(self, "regularizer")

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


_ITERATIONS = 6
_MOST_FACES = 1 << 21


@dataclass(frozen=True)
class Remeshing:
    """Steps at which a mesh with unknown vertex positions is remeshed, and the method.

    "isotropic" makes triangles of even size on the same surface (Botsch and Kobbelt 2004, "A Remeshing Approach to Multiresolution
    Modeling"), by gpytoolbox. The mesh must be a manifold, with or without borders, and have no texture coordinates, because new vertices
    would have none. "subdivide" divides each triangle into four in the same plane. It accepts any mesh and preserves texture coordinates
    and seams.

    The optimizer's state of the vertices restarts at the step; its schedule and its state of other parameters continue. The estimator
    restarts.

    Args:
        steps: steps of the run at which the mesh is remeshed, counted from 0: ascending, each at least 1.
        method: "isotropic" or "subdivide".
        edge: for "isotropic", edge length relative to the current mean, > 0. 0.5 makes about four times as many triangles.
    """

    steps: tuple[int, ...]
    method: Literal["isotropic", "subdivide"] = "isotropic"
    edge: Positive = 0.5

    def __post_init__(self):
        object.__setattr__(self, "steps", checked_steps("Remeshing", self.steps))
        checks.fields(self)

    def check(self, positions: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> None:
        """Raise `InputError` for an unsuitable mesh: positions (V, 3), faces (F, 3), texture coordinates (V, 2) or None."""
        if self.method == "subdivide":
            return
        if uv is not None:
            raise InputError(
                'its mesh has texture coordinates, which isotropic remeshing cannot preserve; use method = "subdivide"'
            )
        shared, count = _edges(_joined(positions, faces)[1])
        if (count > 2).any():
            raise InputError(
                f"its mesh is not a manifold: {int((count > 2).sum())} of {len(shared)} edges have more than two faces; "
                'use method = "subdivide"'
            )
        try:
            import gpytoolbox  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise InputError(
                f"isotropic remeshing needs gpytoolbox: pip install 'unrender[remesh]' ({error})"
            ) from error

    def apply(self, positions: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> ReplacedMesh:
        """Return the new mesh. Raises `InputError` if it would have more than two million faces, or none."""
        if self.method == "subdivide":
            _check_size(4 * len(faces))
            return _subdivided(positions, faces, uv)
        self.check(positions, faces, uv)
        from gpytoolbox import remesh_botsch  # pyright: ignore[reportMissingImports]

        points, joined = _joined(positions, faces)
        i, j = _edges(joined)[0].T
        length = self.edge * float(np.linalg.norm(points[i] - points[j], axis=1).mean())
        _check_size(int(len(faces) / min(self.edge, 1.0) ** 2))
        vertices, made = remesh_botsch(points.astype(np.float64), joined.astype(np.int32), _ITERATIONS, length, True)
        if not len(made) or not np.isfinite(vertices).all():
            raise InputError(
                f"isotropic remeshing removed every face of a mesh of {len(faces)} faces; use a smaller edge"
            )
        return ReplacedMesh(np.asarray(vertices, np.float64), np.asarray(made, np.int64))


def remeshing_of(value: Any) -> Remeshing:
    """Return the remeshing of a parameter from an instance, a list of steps or a table of options. Raises `InputError`."""
    if isinstance(value, Remeshing):
        return value
    if not isinstance(value, (Mapping, Sequence)) or isinstance(value, str):
        raise InputError(
            f"expected steps such as [100, 200], or a table such as {{ steps = [100] }}, got {in_words(value)}"
        )
    return tables.build(Remeshing, dict(value) if isinstance(value, Mapping) else {"steps": value})


def _check_size(faces: int) -> None:
    if faces > _MOST_FACES:
        raise InputError(f"remeshing would make {faces} faces, more than {_MOST_FACES}")


def _joined(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices at the same position and drop degenerate faces; returns positions (P, 3) and faces."""
    first, places = weld(positions)
    points, joined = positions[first], places[faces]
    nondegenerate = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    joined = joined[nondegenerate]
    used, numbers = np.unique(joined, return_inverse=True)
    return points[used], numbers.reshape(joined.shape)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges as pairs of vertices (E, 2), and the number of faces of each."""
    return np.unique(_sides(faces), axis=0, return_counts=True)


def _sides(faces: np.ndarray) -> np.ndarray:
    """Return the sides ab, bc and ca of all faces (3 F, 2), each with its smaller vertex first."""
    return np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)


def subdivided(faces: np.ndarray, vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Divide each triangle into four at the midpoints of its edges. Return the new faces, and the ends (E, 2) of the divided edges.

    The midpoints, which adjacent triangles share, follow the old vertices in the order of these edges.
    """
    edges, which = np.unique(_sides(faces), axis=0, return_inverse=True)
    (a, b, c), (ab, bc, ca) = faces.T, which.reshape(3, -1) + vertices
    parts = (a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)
    return np.concatenate([np.stack(corners, -1) for corners in parts]), edges


def _subdivided(positions: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> ReplacedMesh:
    made, edges = subdivided(faces, len(positions))
    i, j = edges.T

    def extended(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, (values[i] + values[j]) / 2])

    return ReplacedMesh(extended(positions), made, None if uv is None else extended(uv))


_NO_MESH = "expected no value: this option is for the vertex positions of a mesh"

_Arrays = tuple[np.ndarray, np.ndarray]
_SELF_INTERSECTIONS = ("warn", "prevent", "ignore")


def check_regularizer(value: Any, mesh: _Arrays | None) -> MeshRegularizer | None:
    """Return a regularizer bound to the mesh, (positions, faces); None for none. Raises `InputError`."""
    if value is None:
        return None
    regularizer = tables.options(MeshRegularizer, value, "{ bilaplacian = 0.001 }")
    if mesh is None:
        raise InputError(_NO_MESH)
    return regularizer.on_mesh(*mesh)


def check_remeshing(value: Any, mesh: _Arrays | None, uv: Callable[[], np.ndarray | None]) -> Remeshing | None:
    """Return the remeshing of a mesh (positions, faces), None for another parameter; None for none. Raises `InputError` if it does not suit
    the mesh."""
    if value is None:
        return None
    if mesh is None:
        raise InputError(_NO_MESH)
    setting = remeshing_of(value)
    setting.check(*mesh, uv())
    return setting


def check_self_intersection(choice: Any, mesh: _Arrays | None) -> None:
    """Raise `InputError` for an invalid treatment of self-intersections; see `Parameter`."""
    if not isinstance(choice, str) or choice not in _SELF_INTERSECTIONS:
        raise InputError(f'expected "warn", "prevent" or "ignore", got {in_words(choice)}')
    if choice != "warn" and mesh is None:
        raise InputError(_NO_MESH)


def mesh_notices(key: str, positions: np.ndarray, faces: np.ndarray) -> list[str]:
    """Return a notice about unusual topology as loaded: edges of more than two faces, and triangles without area. Empty if there is
    none."""
    joined = weld(positions)[1][faces]
    flat = np.linalg.norm(area_normals(positions.astype(np.float64), faces), axis=1) == 0
    used = ~flat & (joined != np.roll(joined, 1, axis=1)).all(axis=1)
    sides = np.sort(joined[used][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    crowded = int(np.sum(np.unique(sides, axis=0, return_counts=True)[1] > 2)) if len(sides) else 0
    words = [f"{crowded} edges of more than two faces"] if crowded else []
    words += [f"{int(flat.sum())} triangles without area"] if flat.any() else []
    return [f"parameter {key}: its mesh has {' and '.join(words)}, which are treated as borders"] if words else []


def check_surfaces(surfaces: Mapping[str, Surface], faces: Mapping[str, np.ndarray]) -> None:
    """Raise `FieldError` for a true surface of a parameter that is not the vertex positions of a mesh."""
    checks.optional("surfaces", surfaces, Mapping, "surfaces by key of the parameters")
    for key, surface in surfaces.items():
        if not isinstance(surface, Surface):
            what = f"expected an unrender.scene.surfaces.Surface, got {type(surface).__name__}"
            raise FieldError(("surfaces", key), what)
        if key not in faces:
            raise FieldError(("surfaces", key), f"no vertex positions among the parameters{did_you_mean(key, faces)}")
