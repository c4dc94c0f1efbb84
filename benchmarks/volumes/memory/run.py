"""Memory of a radiance field's grids, by method: `nerf-volume` at 64³, 128³ and 256³ voxels.

Each method in a process of its own: its greatest resident size after a few steps, less that of the same method at 16³,
over the bytes of the unknowns (extinction and emission, 4 floats a voxel). So many copies of the unknowns a method needs,
scenes, gradients, states and NumPy's arrays included. On a GPU it is the peak of the device's memory, in which NumPy has no share.
"""

from __future__ import annotations

import resource
from typing import Any

import unrender as ur
from benchmarks.internals import allocated, method_parts
from benchmarks.runner.timing import in_new_process

METHODS = ("plain", "rcv", "meta", "coupled")
SMALL = 16
MERGE = ("methods",)
QUICK = {"method": ("plain",), "grid": (20,), "steps": 2}


def peak(method: str, grid: int, steps: int) -> float:
    """Bytes, of this process; on a GPU, of the device."""
    on_gpu = ur.use().startswith("cuda")
    device = allocated()
    problem = ur.gallery.problem("nerf-volume", resolution=32, grid_resolution=grid, views=2, reference_spp=1)
    ur.optimize(problem, *method_parts(method), steps=steps)
    return float(device()) if on_gpu else 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def run(method: tuple[str, ...] = METHODS, grid: tuple[int, ...] = (64, 128, 256), steps: int = 4) -> dict[str, Any]:
    """Bytes, and copies of the unknowns.

    Args:
        grid: voxels along a side
    """
    found: dict[str, Any] = {}
    for name in method:
        nothing = in_new_process(peak, name, SMALL, steps)
        found[name] = {"small_bytes": nothing}
        for side in grid:
            size, unknowns = in_new_process(peak, name, side, steps), 16.0 * side**3
            copies = (size - nothing) / unknowns
            found[name][str(side)] = {"bytes": size, "unknowns": unknowns, "copies": copies}
            print(name, side, f"{size / 1e9:.2f} GB", f"{copies:.1f} copies", flush=True)
    return {"methods": found}
