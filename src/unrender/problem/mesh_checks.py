"""What the user gives of meshes among a problem's parameters, checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.evaluation.surfaces import Surface
from unrender.problem import mesh_regularizer, remeshing
from unrender.problem.errors import FieldError
from unrender.problem.mesh_regularizer import MeshRegularizer
from unrender.problem.remeshing import Remeshing
from unrender.rendering.renderer import ParameterInfo

__all__ = ["check_regularizer", "check_remeshing", "check_surfaces", "faces_of"]


def check_regularizer(given: Any, info: ParameterInfo) -> MeshRegularizer:
    """A regularizer bound to the mesh. Raises `InputError`."""
    regularizer = mesh_regularizer.of(given)
    if info.mesh is None:
        raise InputError("expected none: it is of the vertex positions of a mesh")
    return regularizer.on_mesh(*info.mesh())


def check_remeshing(given: Any, info: ParameterInfo, uv: np.ndarray | None) -> Remeshing:
    """When a mesh gets other triangles, of what was given. Raises `InputError` where it does not suit the mesh."""
    found = remeshing.of(given)
    if info.mesh is None:
        raise InputError("expected none: it is of the vertex positions of a mesh")
    found.check(*info.mesh(), uv)
    return found


def faces_of(info: ParameterInfo) -> np.ndarray:
    """(F, 3) of the mesh whose vertex positions a parameter holds."""
    assert info.mesh is not None
    return np.asarray(info.mesh()[1]).astype(np.int64).reshape(-1, 3)


def check_surfaces(surfaces: Mapping[str, Surface], faces: Mapping[str, np.ndarray]) -> None:
    """Raise `FieldError` for a surface of what is no mesh among the parameters."""
    for key, surface in surfaces.items():
        if not isinstance(surface, Surface):
            what = f"expected an unrender.evaluation.surfaces.Surface, got {type(surface).__name__}"
            raise FieldError(("surfaces", key), what)
        if key not in faces:
            raise FieldError(("surfaces", key), f"no vertex positions among the parameters{did_you_mean(key, faces)}")
