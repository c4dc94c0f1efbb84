"""The meshes of a run folder: which faces the vertices among its parameters make, and the true surfaces where they are known."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import printable
from unrender.io import files, mesh_files
from unrender.scene.problem import Problem
from unrender.scene.surfaces import Surface

FOLDER = "meshes"
"""Of PLY and OBJ files."""
_FACES, _FIRST, _UV, _VERTICES, _TRUE_FACES = "faces", "first_faces", "uv", "true_vertices", "true_faces"


@dataclass(frozen=True, eq=False)
class RunMesh:
    """A mesh whose vertex positions are a parameter.

    Attributes:
        faces: (F, 3), numbers of vertices.
        first_faces: those of the start, which are others where the mesh was remeshed on the way.
        truth: its true surface; None where it is not known.
        uv: (V, 2) texture coordinates of a mesh that was remeshed; None where there are none.
    """

    faces: np.ndarray
    first_faces: np.ndarray
    truth: Surface | None
    uv: np.ndarray | None = None


def arrays_of(problem: Problem, before: Mapping[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    """What meshes.npz holds: {"KEY/faces": (F, 3), "KEY/true_vertices": (W, 3), "KEY/true_faces": (G, 3)}; and "KEY/first_faces", those of
    `before`, of meshes that have other faces now, and "KEY/uv" (V, 2) where these have texture coordinates."""
    found: dict[str, np.ndarray] = {f"{key}/{_FACES}": x.astype(np.int32) for key, x in problem.faces.items()}
    for key in problem.faces:
        if before is None:
            break
        first = before.get(f"{key}/{_FIRST}", before[f"{key}/{_FACES}"])
        if not np.array_equal(first, found[f"{key}/{_FACES}"]):
            found[f"{key}/{_FIRST}"] = first
            if (uv := problem.texture_coordinates(key)) is not None:
                found[f"{key}/{_UV}"] = uv.astype(np.float32)
    for key, surface in ((key, unknown.surface) for key, unknown in problem.unknowns.items()):
        if surface is None:
            continue
        found[f"{key}/{_VERTICES}"] = surface.vertices.astype(np.float32)
        found[f"{key}/{_TRUE_FACES}"] = surface.faces.astype(np.int32)
    return found


def meshes_in(
    arrays: Mapping[str, np.ndarray],
    parameters: Mapping[str, np.ndarray],
    initial: Mapping[str, np.ndarray],
    path: Path,
) -> dict[str, RunMesh]:
    """{key: mesh}, from what meshes.npz holds. Raises `InputError` that names `path` for arrays that make no mesh of the parameters."""
    found = {}
    for key, values in parameters.items():
        faces = arrays.get(f"{key}/{_FACES}")
        if faces is None or not len(faces):
            continue
        truth = arrays.get(f"{key}/{_VERTICES}"), arrays.get(f"{key}/{_TRUE_FACES}")
        try:
            checked = _checked(faces, values)
            first = _checked(arrays.get(f"{key}/{_FIRST}", faces), initial[key])
            uv = arrays.get(f"{key}/{_UV}")
            if uv is not None and uv.shape != (values.size // 3, 2):
                raise InputError(f"surface: expected texture coordinates of shape (V, 2), got {uv.shape}")
            surface = None if truth[0] is None or truth[1] is None else Surface(truth[0], truth[1])
        except InputError as error:
            raise InputError(f"{path}: {printable(key)}: {error}") from error
        found[key] = RunMesh(checked, first, surface, uv)
    return found


def _checked(faces: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Faces of vertex positions (3 V,), whatever these are. Raises `InputError`."""
    if positions.ndim != 1 or positions.size % 3:
        raise InputError(f"surface: expected vertices of shape (3 V,), got {positions.shape}")
    return Surface(np.arange(positions.size, dtype=float).reshape(-1, 3) ** 2, faces).faces  # of some area


def write_files(folder: Path, problem: Problem, parameters: Mapping[str, np.ndarray]) -> None:
    """Write meshes/NAME.ply and meshes/NAME.obj in a run folder, with texture coordinates where the mesh has them."""
    for key, faces in problem.faces.items():
        name = re.sub(r"[^A-Za-z0-9._-]", "_", key.rpartition(".")[0])[:100] or "mesh"
        vertices, uv = np.asarray(parameters[key], np.float32).reshape(-1, 3), problem.texture_coordinates(key)
        (folder / FOLDER).mkdir(exist_ok=True)
        files.write(folder / FOLDER / f"{name}.ply", mesh_files.ply(vertices, faces, uv=uv), name_too=False)
        files.write(folder / FOLDER / f"{name}.obj", mesh_files.obj(vertices, faces, uv))
