"""Validation of the settings for meshes among a problem's parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from unrender.core import tables
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.io.toml_lines import FieldError
from unrender.scene import remeshing
from unrender.scene.mesh_regularizer import MeshRegularizer
from unrender.scene.remeshing import Remeshing
from unrender.scene.surfaces import Surface, area_normals

_NO_MESH = "expected no value: this option is for the vertex positions of a mesh"

_Mesh = tuple[np.ndarray, np.ndarray]
_SELF_INTERSECTIONS = ("warn", "prevent", "ignore")


def check_regularizer(value: Any, mesh: _Mesh | None) -> MeshRegularizer | None:
    """Return a regularizer bound to the mesh, (positions, faces); None for none. Raises `InputError`."""
    if value is None:
        return None
    regularizer = tables.options(MeshRegularizer, value, "{ bilaplacian = 0.001 }")
    if mesh is None:
        raise InputError(_NO_MESH)
    return regularizer.on_mesh(*mesh)


def check_remeshing(value: Any, mesh: _Mesh | None, uv: Callable[[], np.ndarray | None]) -> Remeshing | None:
    """Return the remeshing of a mesh; None for none. Raises `InputError` if it does not suit the mesh.

    Args:
        value: the user's setting.
        mesh: (positions, faces); None if the parameter is not the vertex positions of a mesh.
        uv: function that returns the texture coordinates, or None if there are none.
    """
    if value is None:
        return None
    if mesh is None:
        raise InputError(_NO_MESH)
    setting = remeshing.of(value)
    setting.check(*mesh, uv())
    return setting


def check_self_intersection(choice: Any, mesh: _Mesh | None) -> None:
    """Raise `InputError` for an invalid treatment of self-intersections; see `Parameter`."""
    if choice not in _SELF_INTERSECTIONS:
        raise InputError(f'expected "warn", "prevent" or "ignore", got {choice!r}')
    if choice != "warn" and mesh is None:
        raise InputError(_NO_MESH)


def mesh_notices(key: str, positions: np.ndarray, faces: np.ndarray) -> list[str]:
    """Return a notice about unusual topology: edges of more than two faces, and triangles without area. Empty if there is none.

    Args:
        key: key of the vertex positions.
        positions: vertex positions as loaded, (V, 3).
        faces: vertex indices, (F, 3).
    """
    _, places = np.unique(positions, axis=0, return_inverse=True)
    joined = places.reshape(-1)[faces]
    flat = np.linalg.norm(area_normals(positions.astype(np.float64), faces), axis=1) == 0
    sides = np.sort(joined[~flat][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    crowded = int(np.sum(np.unique(sides, axis=0, return_counts=True)[1] > 2)) if len(sides) else 0
    words = [f"{crowded} edges of more than two faces"] if crowded else []
    words += [f"{int(flat.sum())} triangles without area"] if flat.any() else []
    return [f"parameter {key}: its mesh has {' and '.join(words)}, which are treated as borders"] if words else []


def check_surfaces(surfaces: Mapping[str, Surface], faces: Mapping[str, np.ndarray]) -> None:
    """Raise `FieldError` for a true surface of a parameter that is not the vertex positions of a mesh."""
    for key, surface in surfaces.items():
        if not isinstance(surface, Surface):
            what = f"expected an unrender.scene.surfaces.Surface, got {type(surface).__name__}"
            raise FieldError(("surfaces", key), what)
        if key not in faces:
            raise FieldError(("surfaces", key), f"no vertex positions among the parameters{did_you_mean(key, faces)}")
