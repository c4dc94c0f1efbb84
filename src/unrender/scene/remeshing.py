"""Meshes that get other triangles while a descent goes on: even ones, or each cut into four."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from unrender.core import checks, tables
from unrender.core.errors import InputError
from unrender.rendering.renderer import ReplacedMesh
from unrender.scene.coarse_to_fine import checked_steps

_ITERATIONS = 6
_MOST_FACES = 1 << 21


@dataclass(frozen=True)
class Remeshing:
    """When a mesh whose vertex positions are unknown gets other triangles, and which.

    "isotropic" makes triangles of even size on the same surface (Botsch and Kobbelt 2004, "A Remeshing Approach to Multiresolution
    Modeling"), by gpytoolbox; the mesh must be a manifold, with or without borders, and have no texture coordinates, which new vertices
    would not have. "subdivide" cuts each triangle into four of the same plane; texture coordinates and seams are kept, and any mesh
    will do.

    What the optimizer remembers of the vertices begins anew at the step, its schedule and what it remembers of other parameters go on; the
    estimator begins anew.

    Args:
        steps: before which of the run's steps, counted from 0: ascending, each at least 1.
        method: see above.
        edge: "isotropic": length of an edge, as a share of the present mean, > 0. 0.5 makes about four times as many triangles.
    """

    steps: tuple[int, ...]
    method: Literal["isotropic", "subdivide"] = "isotropic"
    edge: float = 0.5

    def __post_init__(self):
        object.__setattr__(self, "steps", checked_steps("Remeshing", self.steps))
        if self.method not in ("isotropic", "subdivide"):
            raise InputError(f'Remeshing: method must be "isotropic" or "subdivide", got {self.method!r}')
        checks.number("Remeshing", "edge", self.edge, above=0.0)

    def check(self, positions: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> None:
        """Raise `InputError` for a mesh that it does not suit: positions (V, 3), faces (F, 3), texture coordinates (V, 2) or None."""
        if self.method == "subdivide":
            return
        if uv is not None:
            raise InputError(
                'its mesh has texture coordinates, which isotropic remeshing cannot carry over: method = "subdivide" keeps them'
            )
        shared, count = _edges(_joined(positions, faces)[1])
        if (count > 2).any():
            raise InputError(
                f'its mesh is no manifold: {int((count > 2).sum())} of {len(shared)} edges have more than two faces: method = "subdivide" '
                "takes any"
            )
        try:
            import gpytoolbox  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise InputError(
                f"isotropic remeshing needs gpytoolbox: pip install 'unrender[remesh]' ({error})"
            ) from error

    def apply(self, positions: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> ReplacedMesh:
        """The new mesh. Raises `InputError` where it would have more than two million faces, or nothing is left of it."""
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
                f"isotropic remeshing left nothing of a mesh of {len(faces)} faces: a smaller edge keeps more"
            )
        return ReplacedMesh(np.asarray(vertices, np.float64), np.asarray(made, np.int64))


def of(given: Any) -> Remeshing:
    """What a parameter was given: one, its steps alone, or a table of its options. Raises `InputError`."""
    if isinstance(given, Remeshing):
        return given
    if not isinstance(given, (Mapping, Sequence)) or isinstance(given, str):
        raise InputError(
            f"expected steps such as [100, 200], or a table such as {{ steps = [100] }}, got {given!r:.60}"
        )
    return tables.build(Remeshing, dict(given) if isinstance(given, Mapping) else {"steps": given})


def _check_size(faces: int) -> None:
    if faces > _MOST_FACES:
        raise InputError(f"remeshing would make {faces} faces, more than {_MOST_FACES}")


def _joined(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (P, 3) and faces of these, those without area in number left out: vertices at the same place are one."""
    points, places = np.unique(positions, axis=0, return_inverse=True)
    joined = places.reshape(-1)[faces]
    whole = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    joined = joined[whole]
    used, numbers = np.unique(joined, return_inverse=True)
    return points[used], numbers.reshape(joined.shape)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of vertices that an edge joins (E, 2), and how many faces each has."""
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(sides, axis=0, return_counts=True)


def _subdivided(positions: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> ReplacedMesh:
    """Each triangle cut into four at the middles of its edges; the old vertices come first."""
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, which = np.unique(sides, axis=0, return_inverse=True)
    ab, bc, ca = which.reshape(3, -1) + len(positions)
    a, b, c = faces.T
    made = np.concatenate([np.stack(t, -1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    i, j = edges.T

    def extended(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, (values[i] + values[j]) / 2])

    return ReplacedMesh(extended(positions), made, None if uv is None else extended(uv))
