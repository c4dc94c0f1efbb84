"""Remeshing during an optimisation: triangles of even size, or subdivision."""

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
    edge: float = 0.5

    def __post_init__(self):
        object.__setattr__(self, "steps", checked_steps("Remeshing", self.steps))
        if self.method not in ("isotropic", "subdivide"):
            raise InputError(f'Remeshing: method must be "isotropic" or "subdivide", got {self.method!r}')
        checks.number("Remeshing", "edge", self.edge, above=0.0)

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


def of(value: Any) -> Remeshing:
    """Return the remeshing of a parameter from an instance, a list of steps or a table of options. Raises `InputError`."""
    if isinstance(value, Remeshing):
        return value
    if not isinstance(value, (Mapping, Sequence)) or isinstance(value, str):
        raise InputError(
            f"expected steps such as [100, 200], or a table such as {{ steps = [100] }}, got {value!r:.60}"
        )
    return tables.build(Remeshing, dict(value) if isinstance(value, Mapping) else {"steps": value})


def _check_size(faces: int) -> None:
    if faces > _MOST_FACES:
        raise InputError(f"remeshing would make {faces} faces, more than {_MOST_FACES}")


def _joined(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices at the same position and drop degenerate faces; returns positions (P, 3) and faces."""
    points, places = np.unique(positions, axis=0, return_inverse=True)
    joined = places.reshape(-1)[faces]
    nondegenerate = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    joined = joined[nondegenerate]
    used, numbers = np.unique(joined, return_inverse=True)
    return points[used], numbers.reshape(joined.shape)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges as pairs of vertices (E, 2), and the number of faces of each."""
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(sides, axis=0, return_counts=True)


def _subdivided(positions: np.ndarray, faces: np.ndarray, uv: np.ndarray | None) -> ReplacedMesh:
    """Divide each triangle into four at the midpoints of its edges; the old vertices come first."""
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, which = np.unique(sides, axis=0, return_inverse=True)
    ab, bc, ca = which.reshape(3, -1) + len(positions)
    a, b, c = faces.T
    made = np.concatenate([np.stack(t, -1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    i, j = edges.T

    def extended(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, (values[i] + values[j]) / 2])

    return ReplacedMesh(extended(positions), made, None if uv is None else extended(uv))
