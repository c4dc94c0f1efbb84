"""What the user gives of meshes among a problem's parameters, checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.rendering.renderer import ParameterInfo
from unrender.scene import mesh_regularizer, remeshing
from unrender.scene.errors import FieldError
from unrender.scene.mesh_regularizer import MeshRegularizer
from unrender.scene.parameter import Parameter
from unrender.scene.remeshing import Remeshing
from unrender.scene.surfaces import Surface, area_normals

__all__ = ["check_regularizer", "check_remeshings", "check_self_intersections", "check_surfaces", "mesh_notices"]

_SELF_INTERSECTIONS = ("warn", "prevent", "ignore")


def check_regularizer(given: Any, info: ParameterInfo) -> MeshRegularizer:
    """A regularizer bound to the mesh. Raises `InputError`."""
    regularizer = mesh_regularizer.of(given)
    if info.moving_mesh is None:
        raise InputError("expected none: it is of the vertex positions of a mesh")
    return regularizer.on_mesh(*info.moving_mesh())


def check_remeshings(
    parameters: Sequence[Parameter],
    known: Mapping[str, ParameterInfo],
    texture_coordinates: Callable[[str], np.ndarray | None],
) -> dict[str, Remeshing]:
    """{key: when its mesh gets other triangles} of the parameters that say so. Raises `FieldError` where it does not suit the mesh.

    Args:
        parameters: of a problem.
        known: what the renderer says of them.
        texture_coordinates: of a mesh, by the key of its vertex positions; None where it has none.
    """
    found = {}
    for index, parameter in enumerate(parameters):
        if parameter.remeshing is None:
            continue
        key = parameter.key
        try:
            if (mesh := known[key].moving_mesh) is None:
                raise InputError("expected none: it is of the vertex positions of a mesh")
            found[key] = remeshing.of(parameter.remeshing)
            found[key].check(*mesh(), texture_coordinates(key))
        except InputError as error:
            place = ("parameters", index, "remeshing")
            raise FieldError(place, str(error), f"parameter {key}: remeshing") from error
    return found


def check_self_intersections(parameters: Sequence[Parameter], faces: Mapping[str, np.ndarray]) -> dict[str, str]:
    """{key: what is done where its mesh passes through itself} of those that are vertex positions; see `Parameter`. Raises `FieldError`.

    Args:
        parameters: of a problem.
        faces: of their meshes.
    """
    for index, parameter in enumerate(parameters):
        given, place = parameter.self_intersection, ("parameters", index, "self_intersection")
        name = f"parameter {parameter.key}: self_intersection"
        if given not in _SELF_INTERSECTIONS:
            raise FieldError(place, f'expected "warn", "prevent" or "ignore", got {given!r}', name)
        if given != "warn" and parameter.key not in faces:
            raise FieldError(place, "expected none: it is of the vertex positions of a mesh", name)
    return {parameter.key: parameter.self_intersection for parameter in parameters if parameter.key in faces}


def mesh_notices(key: str, positions: np.ndarray, faces: np.ndarray) -> list[str]:
    """A line on what is unusual about the mesh of vertex positions: edges of more than two faces, and triangles without area; none where
    nothing is. Positions as loaded, (V, 3), faces (F, 3)."""
    _, places = np.unique(positions, axis=0, return_inverse=True)
    joined = places.reshape(-1)[faces]
    flat = np.linalg.norm(area_normals(positions.astype(np.float64), faces), axis=1) == 0
    sides = np.sort(joined[~flat][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    crowded = int(np.sum(np.unique(sides, axis=0, return_counts=True)[1] > 2)) if len(sides) else 0
    words = [f"{crowded} edges of more than two faces"] if crowded else []
    words += [f"{int(flat.sum())} triangles without area"] if flat.any() else []
    return [f"parameter {key}: its mesh has {' and '.join(words)}, which count as borders"] if words else []


def check_surfaces(surfaces: Mapping[str, Surface], faces: Mapping[str, np.ndarray]) -> None:
    """Raise `FieldError` for a surface of what is no mesh among the parameters."""
    for key, surface in surfaces.items():
        if not isinstance(surface, Surface):
            what = f"expected an unrender.scene.surfaces.Surface, got {type(surface).__name__}"
            raise FieldError(("surfaces", key), what)
        if key not in faces:
            raise FieldError(("surfaces", key), f"no vertex positions among the parameters{did_you_mean(key, faces)}")
