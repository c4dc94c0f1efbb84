"""Meshes of a run folder: faces of the recovered vertices, and true surfaces if known."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unrender.core.errors import InputError, prefixed
from unrender.core.text import printable
from unrender.io import files, mesh_files
from unrender.scene.problem import Problem
from unrender.scene.surfaces import Surface

FOLDER = "meshes"
"""Folder of PLY and OBJ files."""
_FACES, _FIRST, _UV, _VERTICES, _TRUE_FACES = "faces", "first_faces", "uv", "true_vertices", "true_faces"


@dataclass(frozen=True, eq=False)
class RunMesh:
    """A mesh whose vertex positions are a parameter.

    Attributes:
        faces: vertex indices, (F, 3).
        first_faces: faces at the start, which differ if the mesh was remeshed.
        truth: true surface; None if unknown.
        uv: texture coordinates (V, 2) of a remeshed mesh; None if there are none.
    """

    faces: np.ndarray
    first_faces: np.ndarray
    truth: Surface | None
    uv: np.ndarray | None = None


def arrays_of(problem: Problem, before: Mapping[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    """Return the contents of meshes.npz: {"KEY/faces": (F, 3), "KEY/true_vertices": (W, 3), "KEY/true_faces": (G, 3)}.

    For meshes whose faces differ from those in `before`, it also contains the earlier ones, "KEY/first_faces", and "KEY/uv" (V, 2) if
    there are texture coordinates.
    """
    contents: dict[str, np.ndarray] = {f"{key}/{_FACES}": x.astype(np.int32) for key, x in problem.faces.items()}
    for key in problem.faces:
        if before is None:
            break
        first = before.get(f"{key}/{_FIRST}", before[f"{key}/{_FACES}"])
        if not np.array_equal(first, contents[f"{key}/{_FACES}"]):
            contents[f"{key}/{_FIRST}"] = first
            if (uv := problem.texture_coordinates(key)) is not None:
                contents[f"{key}/{_UV}"] = uv.astype(np.float32)
    for key, surface in ((key, unknown.surface) for key, unknown in problem.unknowns.items()):
        if surface is None:
            continue
        contents[f"{key}/{_VERTICES}"] = surface.vertices.astype(np.float32)
        contents[f"{key}/{_TRUE_FACES}"] = surface.faces.astype(np.int32)
    return contents


def meshes_in(
    arrays: Mapping[str, np.ndarray],
    parameters: Mapping[str, np.ndarray],
    initial: Mapping[str, np.ndarray],
    path: Path,
) -> dict[str, RunMesh]:
    """Return {key: mesh} from the contents of meshes.npz. Raises `InputError` that names `path` if arrays do not fit the parameters."""
    meshes = {}
    for key, values in parameters.items():
        faces = arrays.get(f"{key}/{_FACES}")
        if faces is None or not len(faces):
            continue
        truth = arrays.get(f"{key}/{_VERTICES}"), arrays.get(f"{key}/{_TRUE_FACES}")
        with prefixed(f"{path}: {printable(key)}"):
            checked = _checked(faces, values)
            first = _checked(arrays.get(f"{key}/{_FIRST}", faces), initial[key])
            uv = arrays.get(f"{key}/{_UV}")
            if uv is not None and uv.shape != (values.size // 3, 2):
                raise InputError(f"surface: expected texture coordinates of shape (V, 2), got {uv.shape}")
            surface = None if truth[0] is None or truth[1] is None else Surface(truth[0], truth[1])
        meshes[key] = RunMesh(checked, first, surface, uv)
    return meshes


def surfaces_in(arrays: Mapping[str, np.ndarray]) -> dict[str, Surface]:
    """Return {key: true surface} from the contents of meshes.npz. Raises `InputError` for arrays that are no surface."""
    ends = f"/{_VERTICES}", f"/{_TRUE_FACES}"
    keys = [name.removesuffix(ends[0]) for name in arrays if name.endswith(ends[0])]
    return {key: Surface(arrays[key + ends[0]], arrays[key + ends[1]]) for key in keys if key + ends[1] in arrays}


def _checked(faces: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the faces after checking them against vertex positions (3 V,), whatever their values. Raises `InputError`."""
    if positions.ndim != 1 or positions.size % 3:
        raise InputError(f"surface: expected vertices of shape (3 V,), got {positions.shape}")
    return Surface(
        np.arange(positions.size, dtype=float).reshape(-1, 3) ** 2, faces
    ).faces  # positions with positive areas


def write_files(folder: Path, problem: Problem, parameters: Mapping[str, np.ndarray]) -> None:
    """Write meshes/NAME.ply and meshes/NAME.obj in a run folder, with texture coordinates if the mesh has them."""
    for key, faces in problem.faces.items():
        name = re.sub(r"[^A-Za-z0-9._-]", "_", key.rpartition(".")[0])[:100] or "mesh"
        vertices, uv = np.asarray(parameters[key], np.float32).reshape(-1, 3), problem.texture_coordinates(key)
        (folder / FOLDER).mkdir(exist_ok=True)
        files.write(folder / FOLDER / f"{name}.ply", mesh_files.ply(vertices, faces, uv=uv), name_too=False)
        files.write(folder / FOLDER / f"{name}.obj", mesh_files.obj(vertices, faces, uv))
