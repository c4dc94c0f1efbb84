"""The cost of a perturbed render: `bunny`, poses by transformed rays against vertices that are moved and rendered anew.

One launch renders a batch of poses; milliseconds per perturbation, of the call and of its kernels alone, by the size of
the batch. The alternative: the mesh's vertices are transformed on the device and written to the scene, whose
acceleration structure is rebuilt, and `mi.render` renders it, as a user of stock Mitsuba does it. Both trace the same
scene to the same depth.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, black_box, dr, mi, stock_scene
from benchmarks.kernel_history import kernels
from benchmarks.runner.timing import medians, turns

BATCHES = (1, 2, 4, 8, 16, 32, 64)
QUICK = {"resolution": 8, "spp": 1, "detail": (1,), "batches": (1, 2)}


def by_batch(problem: ur.Problem, spp: int, sizes: tuple[int, ...]) -> list[dict[str, float]]:
    """Per size of the batch: milliseconds per perturbation, wall and kernels, and kernels that were new after warm-up."""
    parameters = problem.initial()
    rng = np.random.default_rng(0)

    def renders(points: np.ndarray) -> Any:
        return lambda number: black_box(problem, parameters, spp, Key(0, number))(points)

    contenders = {str(size): renders(0.2 * rng.standard_normal((size, len(parameters)))) for size in sizes}
    wall, rows = medians(turns(contenders)), []
    for size in sizes:
        inside, new, _ = kernels(contenders[str(size)], range(100, 110))
        rows.append({"size": size, "wall": wall[str(size)] / size, "kernels": inside / size, "new": new})
        print({key: round(value, 3) for key, value in rows[-1].items()}, flush=True)
    return rows


def moved_vertices(problem: ur.Problem, spp: int) -> dict[str, float]:
    """Milliseconds of a render with moved vertices, and of one with nothing moved, by `mi.render`."""
    scene, parameters = stock_scene(problem)
    integrator = mi.load_dict({"type": "path", "max_depth": problem.max_depth})
    key = "bunny.vertex_positions"
    rest = dr.unravel(mi.Point3f, mi.Float(parameters[key]))
    dr.eval(rest)

    def still(number: int) -> None:
        dr.eval(mi.render(scene, integrator=integrator, spp=spp, seed=mi.UInt32(number)))

    def moved(number: int) -> None:
        turn = mi.Transform4f().rotate([0, 1, 0], mi.Float(3.0 * number))
        parameters[key] = dr.ravel(turn @ rest)
        parameters.update()
        still(number)

    return medians(turns({"moved": moved, "still": still}))


def run(
    resolution: int = 64, spp: int = 4, detail: tuple[int, ...] = (1, 3), batches: tuple[int, ...] = BATCHES
) -> dict[str, Any]:
    """Both, for each detail of the mesh.

    Args:
        detail: of the meshes
        batches: sizes of batches
    """
    meshes = {}
    for level in detail:
        problem = ur.gallery.problem("bunny", resolution=resolution, detail=level, reference_spp=16)
        count = stock_scene(problem)[1]["bunny.vertex_positions"].shape[0] // 3
        rows, other = by_batch(problem, spp, batches), moved_vertices(problem, spp)
        meshes[f"{count} vertices"] = {
            "batches": rows,
            **other,
            "speedup": other["moved"] / rows[-1]["wall"],
            "best": min(row["wall"] for row in rows),
        }
    return {"meshes": meshes}
