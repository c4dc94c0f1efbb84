"""Texture atlases by xatlas, in a subprocess with a time limit, since xatlas does not terminate on some meshes and cannot be interrupted.

`python -m unrender.app.capture.atlas IN.npz OUT.npz` runs this module as the subprocess.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from unrender.app.capture.mesh import Mesh, normals
from unrender.core.errors import InputError

SECONDS = 120.0
"""Time limit in seconds; 10 000 faces take 2 seconds, 20 000 faces 15."""
_PADDING = 3
"""Texels between charts, before the atlas is scaled down slightly."""
_COMMAND = (sys.executable, "-m", "unrender.app.capture.atlas")


def check_installed() -> None:
    """Raise `InputError` if xatlas is missing."""
    if importlib.util.find_spec("xatlas") is None:
        raise InputError("a mesh without texture coordinates needs xatlas: pip install 'unrender[capture]'")


def unwrap(mesh: Mesh, resolution: int, seconds: float = SECONDS, command: tuple[str, ...] = _COMMAND) -> Mesh:
    """Return the mesh with texture coordinates: one atlas without overlaps, with charts about 2 texels apart.

    Vertices on seams are duplicated. Normals do not change.

    Args:
        mesh: at most 2^31 faces.
        resolution: texels along the atlas's sides.
        seconds: time limit.
        command: command of the subprocess, to which two file names are appended.

    Raises:
        InputError: xatlas is not installed, fails, or exceeds the time limit.
    """
    check_installed()
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
    own = normals(mesh) if mesh.normals is None else mesh.normals
    return Mesh(mesh.vertices[of], faces, uv, own[of])


def _environment() -> dict[str, str]:
    """Return the environment of a subprocess that does not import modules from its current directory."""
    environment = {**os.environ, "PYTHONSAFEPATH": "1"}
    if path := environment.get("PYTHONPATH"):
        environment["PYTHONPATH"] = os.pathsep.join(os.path.abspath(place) for place in path.split(os.pathsep))
    return environment


def _main(mesh_file: str, made: str) -> None:
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
    _main(*sys.argv[1:])
