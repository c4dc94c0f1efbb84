"""Triangle meshes as arrays: normals, smoothing, decimation, files, and texture atlases by xatlas.

xatlas does not terminate on some meshes and cannot be interrupted, so it runs in a subprocess with a time limit: this module.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
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


def shading_normals(mesh: Mesh) -> np.ndarray:
    """Return the mesh's own normals, or those of `normals`."""
    return normals(mesh) if mesh.normals is None else mesh.normals


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
    check_installed()
    import fast_simplification

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
    uv = [] if mesh.uv is None else [("uv", mesh.uv)]
    return mesh_files.ply_of([("xyz", mesh.vertices), (("nx", "ny", "nz"), shading_normals(mesh)), *uv], mesh.faces)


_SECONDS = 120.0  # time limit of an atlas in seconds; 10 000 faces take 2 seconds, 20 000 faces 15
_PADDING = 3  # texels between charts, before the atlas is scaled down slightly
_COMMAND = (sys.executable, "-m", "unrender.app.capture.mesh")


def check_atlas_installed() -> None:
    """Raise `InputError` if xatlas is missing."""
    if importlib.util.find_spec("xatlas") is None:
        raise InputError("a mesh without texture coordinates needs xatlas: pip install 'unrender[capture]'")


def unwrap(mesh: Mesh, resolution: int, seconds: float = _SECONDS, command: tuple[str, ...] = _COMMAND) -> Mesh:
    """Return the mesh with texture coordinates: one atlas without overlaps, with charts about 2 of `resolution` texels apart.

    Vertices on seams are duplicated. Normals do not change. Two file names are appended to the `command` of the subprocess. Raises
    `InputError` if xatlas is not installed, fails, or exceeds the limit of `seconds`.
    """
    check_atlas_installed()
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    with tempfile.TemporaryDirectory(prefix="unrender-atlas-") as folder:
        mesh_file, made = Path(folder, "mesh.npz"), Path(folder, "atlas.npz")
        local = np.ascontiguousarray((mesh.vertices - middle) / extent, np.float32)
        np.savez(mesh_file, vertices=local, faces=mesh.faces.astype(np.uint32), resolution=resolution)
        try:
            # Python searches the current directory for modules first, which may be untrusted.
            done = subprocess.run(
                [*command, str(mesh_file), str(made)],
                timeout=seconds,
                capture_output=True,
                check=False,
                cwd=folder,
                env=_environment(),
            )
        except subprocess.TimeoutExpired as error:
            many = f"{len(mesh.faces)} faces"
            raise InputError(f"the atlas of {many} was not ready within {seconds:g} s: try fewer (--faces)") from error
        if done.returncode or not made.is_file():
            last = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or [f"status {done.returncode}"]
            raise InputError(f"the atlas of {len(mesh.faces)} faces could not be made: {last[0][:200]}")
        with np.load(made, allow_pickle=False) as arrays:
            of, faces, uv = arrays["of"], arrays["faces"].astype(np.int64), arrays["uv"].astype(float)
    return Mesh(mesh.vertices[of], faces, uv, shading_normals(mesh)[of])


def _environment() -> dict[str, str]:
    """Return the environment of a subprocess that does not import modules from its current directory."""
    environment = {**os.environ, "PYTHONSAFEPATH": "1"}
    if path := environment.get("PYTHONPATH"):
        environment["PYTHONPATH"] = os.pathsep.join(os.path.abspath(place) for place in path.split(os.pathsep))
    return environment


def _unwrap_file(mesh_file: str, made: str) -> None:
    """Make the atlas in this process: `python -m unrender.app.capture.mesh IN.npz OUT.npz`."""
    import xatlas  # pyright: ignore[reportMissingImports]

    with np.load(mesh_file, allow_pickle=False) as mesh:
        vertices, faces, resolution = mesh["vertices"], mesh["faces"], int(mesh["resolution"])
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = resolution, _PADDING, True
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices, faces)
    atlas.generate(pack_options=packing)
    if atlas.atlas_count != 1:
        raise SystemExit(f"its charts fill {atlas.atlas_count} atlases")
    of, faces_of_atlas, uv = atlas.get_mesh(0)
    # xatlas treats the resolution as a hint: the atlas is slightly larger, and not square.
    uv = uv * np.array([atlas.width, atlas.height]) / max(atlas.width, atlas.height)
    np.savez(made, of=of, faces=faces_of_atlas, uv=uv.astype(np.float32))


if __name__ == "__main__":
    _unwrap_file(*sys.argv[1:])
