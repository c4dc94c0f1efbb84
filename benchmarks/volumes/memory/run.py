"""Memory of large unknowns, by method: the grids of `nerf-volume` at 64³ to 256³ voxels, and a wall's texture of 4096² and 8192² texels.

Each method in a process of its own: its greatest resident size after a few steps, less that of the same method at 16³ voxels or 64² texels,
over the bytes of the unknowns: extinction and emission, 4 floats a voxel, or reflectance, 3 floats a texel. So many copies of the
unknowns a method needs, scenes, gradients, states and NumPy's arrays included. On a GPU it is the peak of the device's memory, in which
NumPy has no share.
"""

from __future__ import annotations

import resource
import time
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import allocated, method_parts, mi, parts
from benchmarks.runner.timing import in_new_process

METHODS = ("plain", "rcv", "meta", "coupled")
SMALL = {"grid": 16, "texture": 64}
BYTES = {"grid": 16.0, "texture": 12.0}
AXES = {"grid": 3, "texture": 2}
MERGE = ("methods", "textures")
QUICK = {"method": ("plain",), "grid": (20,), "texture": (80,), "texture_method": ("plain",), "steps": 2}


def wall(size: int) -> ur.Problem:
    """A lit wall whose reflectance has size² texels; two views, since it takes more memory to add their gradients."""

    def scene() -> dict[str, Any]:
        texels = mi.Bitmap(np.full((size, size, 3), 0.5, np.float32))
        bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texels, "raw": True}}
        return {
            "type": "scene",
            "left": parts.camera((-0.5, 0, 3), (0, 0, 0), 45.0, 32),
            "right": parts.camera((0.5, 0, 3), (0, 0, 0), 45.0, 32),
            "wall": parts.rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0), bsdf),
            "sky": {"type": "constant", "radiance": parts.colour(1.0, 1.0, 1.0)},
        }

    views = [ur.View(np.full((32, 32, 3), 0.3, np.float32), sensor) for sensor in range(2)]
    return ur.Problem(scene, [ur.Parameter("wall.bsdf.reflectance.data")], views, max_depth=2)


def peak(method: str, kind: str, size: int, steps: int) -> tuple[float, float]:
    """Bytes, of this process; on a GPU, of the device. And its seconds of processor time."""
    on_gpu = ur.use().startswith("cuda")
    device = allocated()
    if kind == "grid":
        problem = ur.gallery.problem("nerf-volume", resolution=32, grid_resolution=size, views=2, reference_spp=1)
    else:
        problem = wall(size)
    ur.optimize(problem, *method_parts(method), steps=steps)
    found = float(device()) if on_gpu else 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return found, time.process_time()


def run(
    method: tuple[str, ...] = METHODS,
    grid: tuple[int, ...] = (64, 128, 256),
    texture_method: tuple[str, ...] = ("plain", "rcv"),
    texture: tuple[int, ...] = (4096, 8192),
    steps: int = 4,
) -> dict[str, Any]:
    """Bytes, and copies of the unknowns.

    Args:
        grid: voxels along a side.
        texture_method: of the textures.
        texture: texels along a side.
    """
    return {
        "methods": _measured("grid", method, grid, steps),
        "textures": _measured("texture", texture_method, texture, steps),
    }


def _measured(kind: str, methods: tuple[str, ...], sizes: tuple[int, ...], steps: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in methods:
        nothing, _ = in_new_process(peak, name, kind, SMALL[kind], steps)
        found[name] = {"small_bytes": nothing}
        for side in sizes:
            size, seconds = in_new_process(peak, name, kind, side, steps)
            unknowns = BYTES[kind] * side ** AXES[kind]
            copies = (size - nothing) / unknowns
            found[name][str(side)] = {"bytes": size, "unknowns": unknowns, "copies": copies, "seconds": seconds}
            print(f"{name} {kind} {side}: {size / 1e9:.2f} GB, {copies:.1f} copies, {seconds:.1f} s", flush=True)
    return found
