"""Triangle meshes as arrays: normals, smoothing, decimation, PLY files."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.io import bounded_files, mesh_files

_SHRINK, _GROW = 0.5, -0.53
_KINDS = (".ply", ".obj")


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3) integers, counter-clockwise seen from outside.
        uv: texture coordinates (V, 2) in [0, 1], or None.
        normals: (V, 3) unit; None for those of `normals`.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    normals: np.ndarray | None = None


def normals(mesh: Mesh) -> np.ndarray:
    """Return vertex normals, (V, 3) unit: means of the faces' normals weighted by their areas."""
    corners = mesh.vertices[mesh.faces]
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(mesh.vertices, dtype=float)
    for corner in range(3):
        np.add.at(total, mesh.faces[:, corner], weighted)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, 1e-30), [0.0, 0.0, 1.0])


def smooth(mesh: Mesh, steps: int) -> Mesh:
    """Apply Taubin smoothing, which does not shrink: `steps` pairs of umbrella operator steps with λ = .5 and µ = -.53.

    G. Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995.
    """
    from scipy import sparse

    count = len(mesh.vertices)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    adjacency = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (count, count))
    adjacency.data[:] = 1.0
    mean = sparse.diags(1 / np.maximum(np.asarray(adjacency.sum(1)).ravel(), 1)) @ adjacency
    vertices = np.asarray(mesh.vertices, float)
    for _ in range(steps):
        for factor in (_SHRINK, _GROW):
            vertices = vertices + factor * (mean @ vertices - vertices)
    return replace(mesh, vertices=vertices, normals=None)


def without_crumbs(mesh: Mesh, share: float) -> Mesh:
    """Return the mesh without connected components that have fewer faces than `share` times those of the largest component."""
    from scipy import sparse
    from scipy.sparse import csgraph

    count = len(mesh.vertices)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    graph = sparse.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    _, parts = csgraph.connected_components(graph, directed=False)
    sizes = np.bincount(parts[mesh.faces[:, 0]], minlength=parts.max() + 1)
    remaining = mesh.faces[sizes[parts[mesh.faces[:, 0]]] >= share * sizes.max()]
    used, faces = np.unique(remaining, return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3))


def check_installed() -> None:
    """Raise `InputError` if the package that `decimate` needs is missing."""
    if importlib.util.find_spec("fast_simplification") is None:
        raise InputError("a first shape needs fast-simplification: pip install 'unrender[capture]'")


def decimate(mesh: Mesh, faces: int) -> Mesh:
    """Simplify to at most about `faces` faces, by quadric error. Raise `InputError` if the required package is missing."""
    if len(mesh.faces) <= faces:
        return mesh
    try:
        import fast_simplification
    except ImportError as error:
        raise InputError(
            f"a first shape needs fast-simplification ({error}): pip install 'unrender[capture]'"
        ) from error
    # The package uses single precision, so centre and normalise the vertices.
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    local: Any = np.ascontiguousarray((mesh.vertices - middle) / extent, np.float32)
    vertices, triangles, *_ = fast_simplification.simplify(local, mesh.faces.astype(np.int32), target_count=faces)
    return Mesh(np.asarray(vertices, float) * extent + middle, np.asarray(triangles, np.int64))


def read(path: Path) -> Mesh:
    """Read the mesh in a PLY or OBJ file, with its texture coordinates if present. Raise `InputError`."""
    if bounded_files.kind(path) != "file":
        raise InputError(f"--mesh {path}: {bounded_files.no_file(path)}")
    if path.suffix.lower() not in _KINDS:
        raise InputError(f"--mesh {path}: expected a {' or '.join(_KINDS)} file")
    import mitsuba as mi

    from unrender.rendering.mitsuba import mesh_layout

    if path.suffix.lower() == ".ply":
        mesh_files.check_ply(path)
    else:
        mesh_files.check_obj(path)
    try:
        loaded = mi.load_dict({"type": path.suffix.lower()[1:], "filename": str(path)})
    except Exception as error:
        raise InputError(
            f"--mesh {path}: Mitsuba could not read it (has it faces?): {' '.join(str(error).split())[:300]}"
        ) from error
    parameters = mesh_layout.traverse(loaded)
    vertices = np.array(mesh_layout.vertex_positions(loaded), float).reshape(-1, 3)
    faces = np.array(parameters[mesh_layout.FACES], np.int64).reshape(-1, 3)
    uv = np.array(parameters[mesh_layout.TEXCOORDS], float).reshape(-1, 2)
    vertex_normals = np.array(parameters[mesh_layout.NORMALS], float).reshape(-1, 3)
    if not len(faces) or not np.isfinite(vertices).all() or not np.ptp(vertices, axis=0).max() > 0:
        raise InputError(f"--mesh {path}: expected triangles with some extent and finite vertices")
    return Mesh(vertices, faces, uv if len(uv) else None, vertex_normals if len(vertex_normals) else None)


def ply(mesh: Mesh) -> bytes:
    """Return the mesh as a binary PLY file with normals, and u and v if present."""
    columns = [("xyz", mesh.vertices), (("nx", "ny", "nz"), normals(mesh) if mesh.normals is None else mesh.normals)]
    columns += [] if mesh.uv is None else [("uv", mesh.uv)]
    names = [name for group, _ in columns for name in group]
    table = np.concatenate([values for _, values in columns], 1).astype("<f4")
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode() + table.tobytes() + faces.tobytes()
