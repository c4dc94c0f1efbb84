"""The meshes of a run folder: which faces the vertices among its parameters make, and the true surfaces where they are known."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import printable
from unrender.evaluation.surfaces import Surface
from unrender.io import files, mesh_writing
from unrender.problem.problem import Problem

__all__ = ["FOLDER", "RunMesh", "arrays_of", "meshes_in", "write_files"]

FOLDER = "meshes"
"""Of PLY and OBJ files."""
_FACES, _VERTICES, _TRUE_FACES = "faces", "true_vertices", "true_faces"


@dataclass(frozen=True, eq=False)
class RunMesh:
    """A mesh whose vertex positions are a parameter.

    Attributes:
        faces: (F, 3), numbers of vertices.
        truth: its true surface; None where it is not known.
    """

    faces: np.ndarray
    truth: Surface | None


def arrays_of(problem: Problem) -> dict[str, np.ndarray]:
    """What meshes.npz holds: {"KEY/faces": (F, 3), "KEY/true_vertices": (W, 3), "KEY/true_faces": (G, 3)}."""
    found = {f"{key}/{_FACES}": faces.astype(np.int32) for key, faces in problem.faces.items()}
    for key, surface in problem.surfaces.items():
        found[f"{key}/{_VERTICES}"] = surface.vertices.astype(np.float32)
        found[f"{key}/{_TRUE_FACES}"] = surface.faces.astype(np.int32)
    return found


def meshes_in(arrays: Mapping[str, np.ndarray], parameters: Mapping[str, np.ndarray], path: Path) -> dict[str, RunMesh]:
    """{key: mesh}, from what meshes.npz holds. Raises `InputError` that names `path` for arrays that make no mesh of the parameters."""
    found = {}
    for key, values in parameters.items():
        faces = arrays.get(f"{key}/{_FACES}")
        if faces is None or not len(faces):
            continue
        truth = arrays.get(f"{key}/{_VERTICES}"), arrays.get(f"{key}/{_TRUE_FACES}")
        try:
            if values.ndim != 1 or values.size % 3:
                raise InputError(f"expected vertices of shape (3 V,), got {values.shape}")
            unit = np.arange(values.size, dtype=float).reshape(-1, 3) ** 2  # of some area, whatever the parameter is
            checked = Surface(unit, faces).faces
            surface = None if truth[0] is None or truth[1] is None else Surface(truth[0], truth[1])
        except InputError as error:
            raise InputError(f"{path}: {printable(key)}: {error}") from error
        found[key] = RunMesh(checked, surface)
    return found


def write_files(folder: Path, problem: Problem, parameters: Mapping[str, np.ndarray]) -> None:
    """Write meshes/NAME.ply and meshes/NAME.obj in a run folder, with texture coordinates where the mesh has them."""
    for key, faces in problem.faces.items():
        name = re.sub(r"[^A-Za-z0-9._-]", "_", key.rpartition(".")[0])[:100] or "mesh"
        vertices, uv = np.asarray(parameters[key], np.float32).reshape(-1, 3), problem.texture_coordinates(key)
        (folder / FOLDER).mkdir(exist_ok=True)
        files.write(folder / FOLDER / f"{name}.ply", mesh_writing.ply(vertices, faces, uv=uv), name_too=False)
        files.write(folder / FOLDER / f"{name}.obj", mesh_writing.obj(vertices, faces, uv))
