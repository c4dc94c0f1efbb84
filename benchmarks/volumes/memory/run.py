"""Memory of a radiance field's grids, by method: `nerf-volume` at 64³, 128³ and 256³ voxels.

    python benchmarks/volumes/memory/run.py [--grid 256] [--steps 4]

Each method in a process of its own: its greatest resident size after a few steps, less that of the same method at 16³, over the bytes of
the unknowns (extinction and emission, 4 floats a voxel). So many copies of the unknowns a method needs, scenes, gradients, states and what
NumPy holds included.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import write

import unrender as ur
from unrender.methods import method

HERE = Path(__file__).resolve().parent
METHODS = ("plain", "rcv", "meta", "coupled")
SMALL, GRIDS = 16, (64, 128, 256)


def peak(by: str, grid: int, steps: int) -> float:
    """Bytes, of this process."""
    ur.use()
    problem = ur.gallery.problem("nerf-volume", resolution=32, grid_resolution=grid, views=2, reference_spp=1)
    ur.optimize(problem, *method(by).start({}), steps)
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grid", type=int, action="append", help="voxels along a side")
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.child:
        print(json.dumps(peak(asked.child[0], int(asked.child[1]), asked.steps)))
        return

    def child(by: str, grid: int) -> float:
        line = [sys.executable, __file__, "--steps", str(asked.steps), "--child", by, str(grid)]
        return json.loads(subprocess.run(line, check=True, capture_output=True, text=True).stdout.splitlines()[-1])

    found: dict[str, Any] = {}
    for by in METHODS:
        nothing = child(by, SMALL)
        found[by] = {"small_bytes": nothing}
        for grid in asked.grid or GRIDS:
            size, unknowns = child(by, grid), 16.0 * grid**3
            found[by][str(grid)] = {"bytes": size, "unknowns": unknowns, "copies": (size - nothing) / unknowns}
            print(by, grid, f"{size / 1e9:.2f} GB", f"{found[by][str(grid)]['copies']:.1f} copies", flush=True)
    write(HERE, {"methods": found})


if __name__ == "__main__":
    main()
