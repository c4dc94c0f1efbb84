# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""What a perturbation costs: `bunny` at 64², 4 spp, poses by rays against vertices that are moved and rendered anew.

    python benchmarks/higher_order/speed/run.py [--resolution 64] [--spp 4] [--detail 1 3]

Ours: one launch for a batch of poses; milliseconds per perturbation, of the call and of its kernels alone, by the size of the batch.
The other: the mesh's vertices are transformed on the device, written to the scene, whose acceleration structure is rebuilt, and
`mi.render` renders it, as a user of stock Mitsuba does it. Both trace the same scene to the same depth, turn by turn.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import drjit as dr
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import median_time, mitsuba_renderer, read, write

import unrender as ur
from unrender.core.random import Key
from unrender.estimators.loss_values import BlackBox

HERE = Path(__file__).resolve().parent
BATCHES = (1, 2, 4, 8, 16, 32, 64)


def batches(problem: ur.Problem, spp: int) -> list[dict[str, float]]:
    """Per size of the batch: milliseconds per perturbation, wall and kernels, and kernels that were new after warm-up."""
    parameters = problem.initial()
    rng = np.random.default_rng(0)
    rows = []
    for size in BATCHES:
        points = 0.2 * rng.standard_normal((size, len(parameters)))

        def render(number: int, points: np.ndarray = points) -> None:
            BlackBox(problem, parameters, spp, Key(0, number)).losses(points)

        wall = median_time(render, 15, 4)
        inside, new, repeats = 0.0, 0, 10
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            for number in range(repeats):
                dr.kernel_history_clear()
                render(100 + number)
                dr.sync_thread()
                history = dr.kernel_history()
                inside += sum(kernel["execution_time"] for kernel in history)
                new += sum(
                    not kernel["cache_hit"] or kernel["cache_disk"]
                    for kernel in history
                    if kernel["type"] == dr.KernelType.JIT
                )
        rows.append({"size": size, "wall": wall[0] / size, "kernels": inside / repeats / size, "new": new})
        print({key: round(value, 3) for key, value in rows[-1].items()}, flush=True)
    return rows


def moved_vertices(problem: ur.Problem, spp: int) -> tuple[float, float]:
    """Milliseconds of a render with moved vertices, and of one with nothing moved, by `mi.render`."""
    renderer = mitsuba_renderer(problem)
    scene, parameters = renderer.pair.previous, renderer.pair.previous_parameters
    integrator = mi.load_dict({"type": "path", "max_depth": problem.max_depth})
    key = "bunny.vertex_positions"
    rest = dr.unravel(mi.Point3f, mi.Float(parameters[key]))
    dr.eval(rest)

    def moved(number: int) -> None:
        turn = mi.Transform4f().rotate([0, 1, 0], mi.Float(3.0 * number))
        parameters[key] = dr.ravel(turn @ rest)
        parameters.update()
        dr.eval(mi.render(scene, integrator=integrator, spp=spp, seed=mi.UInt32(number)))

    def still(number: int) -> None:
        dr.eval(mi.render(scene, integrator=integrator, spp=spp, seed=mi.UInt32(number)))

    return median_time(moved, 15, 4)[0], median_time(still, 15, 4)[0]


def plot(results: dict[str, Any]) -> None:
    """Milliseconds per perturbation over the size of the batch."""
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, entry in results["meshes"].items():
        sizes = [row["size"] for row in entry["batches"]]
        line = axis.plot(sizes, [row["wall"] for row in entry["batches"]], "o-", label=f"{name}: a batch of poses")[0]
        axis.plot(sizes, [row["kernels"] for row in entry["batches"]], ":", color=line.get_color(), label="its kernels")
        axis.axhline(entry["moved"], ls="--", color=line.get_color(), label="moved vertices, mi.render")
    axis.set(xscale="log", yscale="log", xlabel="perturbations in a batch", ylabel="milliseconds per perturbation")
    axis.legend(fontsize=7)
    figure.savefig(HERE / "figure.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--detail", type=int, nargs="+", default=[1, 3], help="of the meshes")
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        began, meshes = time.perf_counter(), {}
        for detail in asked.detail:
            problem = ur.gallery.problem("bunny", resolution=asked.resolution, detail=detail, reference_spp=16)
            count = mitsuba_renderer(problem).parameters()["bunny.vertex_positions"].shape[0] // 3
            rows = batches(problem, asked.spp)
            moved, still = moved_vertices(problem, asked.spp)
            best = min(row["wall"] for row in rows)
            meshes[f"{count} vertices"] = {
                "batches": rows,
                "moved": moved,
                "still": still,
                "speedup": moved / rows[-1]["wall"],
                "best": best,
            }
            print(
                f"{count} vertices: moved {moved:.2f}, still {still:.2f}, ratio {moved / rows[-1]['wall']:.1f}",
                flush=True,
            )
        write(HERE, {"resolution": asked.resolution, "spp": asked.spp, "meshes": meshes})
        print(f"{time.perf_counter() - began:.0f} s")
    plot(read(HERE))


if __name__ == "__main__":
    main()
