"""Spheres deformed into SUZANNE and BANANA (HO Fig. 5), at the paper's numbers of vertices.

SUZANNE: 2562 vertices before pictures of `suzanne.ply` of Mitsuba's tutorials, which is looked for in --meshes. BANANA: 2737
vertices and their colours, before pictures of a banana made by code. Every perturbation of vertices rebuilds the mesh for
every view, so a step is dear and there are thousands of unknowns: a short run. All but CMA-ES perturb neighbours alike, and
step so, by `LargeSteps` (--strength 0: each vertex by itself). σ, its schedule and the number of renders a step are chosen by
hand and the same for all; each method's learning rate or trust radius is the best of three, and of more where it is at an
end, on runs of a third of the time from a seed of their own. OurHVPA takes one product a step in the paper's form, OurJoint
gradient and product from the same renders, OurG is the gradient alone. The error is that of the images: the loss over that at
the start. Seconds are the processor's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import unrender as ur
from benchmarks.higher_order.fig5_mesh import run as fig5_mesh
from benchmarks.higher_order.fig5_mesh.run import smoothed
from benchmarks.higher_order.fig5_shapes import shapes
from benchmarks.internals import dr, vectors, with_preconditioner
from benchmarks.races import TUNING_SEED, search

TASKS = ("SUZANNE", "BANANA")
MERGE = ("tasks.*.methods",)
QUICK = {"task": ("BANANA",), "vertices": 60, "resolution": 8, "seconds": 0.5}

STRENGTH = 19.0
"""λ of the preconditioner, that of Nicolet, Jacobson and Jakob 2021."""
RATES = (3.0, 9.0, 27.0)
"""Of Adam, in units of σ; one for all elements where steps are smooth."""
RADII = (0.5, 1.5, 4.5)
"""Of Newton's steps: by how many σ each element moves at most, in the mean square."""


def _adam(rate: float, smooth: bool) -> ur.optimizers.Adam:
    return ur.optimizers.Adam(rate * fig5_mesh.SIGMA, uniform=smooth)


def _newton(radius: float, n: int) -> ur.optimizers.NewtonCG:
    return ur.optimizers.NewtonCG(trust_radius=radius * math.sqrt(n), iterations=1, line=True)


Make = Callable[[float, int, bool], tuple[Any, Any]]
METHODS: dict[str, tuple[Make, tuple[float, ...]]] = {
    "FR22": (lambda rate, _, smooth: (smoothed(product=True), _adam(rate, smooth)), RATES),
    "CMA-ES": (lambda deviation, _, __: fig5_mesh.cma_es(deviation), (0.1, 0.3, 0.9)),
    "OurG": (lambda rate, _, smooth: (smoothed(), _adam(rate, smooth)), RATES),
    "OurJoint": (lambda radius, n, _: (smoothed(order="hvp"), _newton(radius, n)), RADII),
    "OurHVPA": (
        lambda radius, n, _: (smoothed(fig5_mesh.SAMPLES // 2, order="hvp", joint=False), _newton(radius, n)),
        RADII,
    ),
}
"""From a setting, the number of unknowns and whether perturbations are smooth; and the settings that are tried."""


def problem(task: str, resolution: int, views: int, vertices: int, meshes: Path) -> ur.Problem:
    """One of `TASKS`."""
    if task == "SUZANNE":
        return shapes.suzanne(resolution, views, vertices, meshes)
    return shapes.banana(resolution, views, vertices)


def measure(made: ur.Problem, method: str, seconds: float, runs: int, strength: float) -> dict[str, Any]:
    """One method, tuned, over seeds 0, 1, ..."""
    make, settings = METHODS[method]
    smooth = strength > 0.0 and method != "CMA-ES"
    if smooth:
        made = with_preconditioner(made, ur.preconditioners.LargeSteps(strength), *(p.key for p in made.parameters))

    def descent(setting: float, budget: float, seed: int) -> dict[str, Any]:
        return fig5_mesh.one(made, lambda n: make(setting, n, smooth), budget, seed)

    best, tried = search(settings, lambda setting: descent(setting, seconds / 3, TUNING_SEED)["final"])
    print(made.name, method, tried, flush=True)
    found = [descent(best, seconds, seed) for seed in range(runs)]
    print(made.name, method, best, [run["final"] for run in found], flush=True)
    return {"setting": best, "tried": tried, "runs": found}


def run(
    task: tuple[str, ...] = TASKS,
    seconds: float = 60.0,
    runs: int = 1,
    resolution: int = 32,
    views: int = 2,
    vertices: int = shapes.VERTICES,
    meshes: Path = Path("../shared/assets/tutorials/meshes"),
    strength: float = STRENGTH,
    only: tuple[str, ...] = tuple(METHODS),
) -> Iterator[dict[str, Any]]:
    """A part per task and method.

    Args:
        seconds: processor time of a run
        views: pictures from around
        vertices: of BANANA's sphere, and the most of SUZANNE's
        meshes: folder of suzanne.ply
        strength: λ of LargeSteps, 0 for none
        only: methods to run; the others' figures stay
    """
    dr.set_thread_count(1)
    for name in task:
        made = problem(name, resolution, views, vertices, meshes)
        numbers = vectors.ravel(made.initial()).size
        for method in only:
            found = measure(made, method, seconds, runs, strength)
            entry = {"numbers": numbers, "strength": strength, "methods": {method: found}}
            yield {"tasks": {name if strength else f"{name}, each vertex by itself": entry}}
