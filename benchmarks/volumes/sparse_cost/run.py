"""The cost of sparse participating media: as `volumes.cost`, of a grid that is mostly empty.

A small dense core and a thin shell in a wide empty box.
"""

from __future__ import annotations

from typing import Any

from benchmarks.volumes.cost.run import measure

QUICK = {"resolution": 8, "grid": 8, "spp": 1, "repeats": 2}


def run(resolution: int = 64, grid: int = 64, spp: int = 16, repeats: int = 5) -> dict[str, Any]:
    """A sparse grid.

    Args:
        grid: voxels along a side
    """
    return measure(resolution, grid, spp, repeats, sparse=True)
