"""Spheres deformed into SUZANNE and BANANA (HO Fig. 5), at the paper's numbers of vertices.

SUZANNE: 2562 vertices before pictures of `suzanne.ply` of Mitsuba's tutorials, which is looked for in --meshes. BANANA: 2737
vertices and their colours, before pictures of a banana made by code. Every perturbation of vertices rebuilds the mesh for
every view, so a step is dear and there are thousands of unknowns: a short run. Settings are those of
`higher_order.fig5_mesh`, chosen by hand, and OurHVPA with one product a step in the paper's form. The error is that of the
images: the loss over that at the start. Seconds are the processor's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import unrender as ur
from benchmarks.higher_order.fig5_mesh import run as fig5_mesh
from benchmarks.higher_order.fig5_shapes import shapes
from benchmarks.internals import dr, vectors

TASKS = ("SUZANNE", "BANANA")
MERGE = ("tasks",)
QUICK = {"task": ("BANANA",), "vertices": 60, "resolution": 8, "seconds": 0.5}


def _products(n: int) -> tuple[Any, Any]:
    """The paper's form: a product from renders of its own, and a step along one direction whose length three losses tell."""
    schedule = ur.schedules.Exponential(60, 0.2)
    estimator = ur.SmoothedDerivatives(
        fig5_mesh.SIGMA, fig5_mesh.SAMPLES // 2, "hvp", joint=False, spp=1, schedule=schedule
    )
    return estimator, ur.optimizers.NewtonCG(trust_radius=0.5 * math.sqrt(n), iterations=1, line=True)


METHODS = {**fig5_mesh.METHODS, "OurHVPA": _products}


def problem(task: str, resolution: int, views: int, vertices: int, meshes: Path) -> ur.Problem:
    """One of `TASKS`."""
    if task == "SUZANNE":
        return shapes.suzanne(resolution, views, meshes)
    return shapes.banana(resolution, views, vertices)


def run(
    task: tuple[str, ...] = TASKS,
    seconds: float = 25.0,
    runs: int = 1,
    resolution: int = 32,
    views: int = 2,
    vertices: int = shapes.VERTICES,
    meshes: Path = Path("../shared/assets/tutorials/meshes"),
) -> Iterator[dict[str, Any]]:
    """A part per task.

    Args:
        seconds: processor time of a run
        views: pictures from around
        vertices: of BANANA's sphere
        meshes: folder of suzanne.ply
    """
    dr.set_thread_count(1)
    for name in task:
        made = problem(name, resolution, views, vertices, meshes)
        found: dict[str, Any] = {method: [] for method in METHODS}
        for number in range(runs):
            for method, make in METHODS.items():
                found[method].append(fig5_mesh.one(made, make, seconds, number))
                print(name, method, found[method][-1], flush=True)
        yield {"tasks": {name: {"numbers": vectors.ravel(made.initial()).size, "methods": found}}}
