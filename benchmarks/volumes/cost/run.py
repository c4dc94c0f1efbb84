"""The cost of participating media: primal, pair and adjoint on a grid against Mitsuba's `volpath` and `prbvolpath`.

On one view of `smoke`. All are timed in turns and compared as ratios turn by turn.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import SampleRequest, dr, mi, prepare, scene_description
from benchmarks.runner.timing import medians, ratio, turns
from unrender.gallery import volumes

RATIOS = {
    "throughput of the primal / volpath": ("volpath", "primal"),
    "pair / primal": ("pair", "primal"),
    "adjoint / primal": ("adjoint", "primal"),
    "adjoint of a pair / adjoint": ("adjoint of a pair", "adjoint"),
    "primal and adjoint / prbvolpath's": ("primal and adjoint", "prbvolpath, primal and adjoint"),
}
QUICK = {"resolution": 8, "grid": 8, "spp": 1, "repeats": 2}


def core(resolution: int) -> np.ndarray:
    """Extinction (Z, Y, X, 1) of a small dense ball, and a thin open shell beside it."""
    x, y, z = volumes.positions(resolution)
    ball = 40 * np.clip(1 - np.sqrt((x + 0.4) ** 2 + (y + 0.3) ** 2 + z**2) / 0.2, 0, 1)
    shell = 3 * (np.abs(np.hypot(x - 0.3, z) - 0.35) < 0.06) * (y > 0.2)
    return (ball + shell)[..., None]


def stock(problem: ur.Problem, current: dict[str, Any], spp: int) -> dict[str, Callable[[int], Any]]:
    """Mitsuba's own integrators, each a function of a seed."""
    scene = mi.load_dict(scene_description(problem))
    parameters = mi.traverse(scene)
    for key, value in current.items():
        parameters[key] = mi.TensorXf(value)
    parameters.update()
    depth = problem.max_depth
    volpath, prbvolpath = (mi.load_dict({"type": kind, "max_depth": depth}) for kind in ("volpath", "prbvolpath"))

    def step(seed: int) -> None:
        leaves = {key: mi.TensorXf(value) for key, value in current.items()}
        for key, leaf in leaves.items():
            dr.enable_grad(leaf)
            parameters[key] = leaf
        parameters.update()
        image = mi.render(scene, parameters, integrator=prbvolpath, spp=spp, seed=mi.UInt32(seed))
        dr.backward(dr.sum(image, axis=None))
        dr.eval([dr.grad(leaf) for leaf in leaves.values()])

    return {
        "volpath": lambda n: dr.eval(mi.render(scene, integrator=volpath, spp=spp, seed=mi.UInt32(n))),
        "prbvolpath, primal and adjoint": step,
    }


def contenders(problem: ur.Problem, spp: int, sparse: bool) -> dict[str, Callable[[int], Any]]:
    """What is compared, each a function of a seed."""
    session = prepare(problem, problem.truth, "path")
    values = {
        key: core(len(value)) if sparse and key.endswith("sigma_t.data") else value
        for key, value in problem.truth.items()
    }
    current = {key: problem.renderer.array(value) for key, value in values.items()}
    previous = {key: value * 0.98 for key, value in current.items()}
    weight = problem.renderer.array(np.ones((1, *np.asarray(problem.views[0].reference).shape)))
    image = session.image(current, SampleRequest(0, spp, 1)).paths
    pair = session.image_pair(current, previous, SampleRequest(0, spp, 1), "path").paths
    return {
        "primal": lambda n: session.image(current, SampleRequest(0, spp, n)),
        "pair": lambda n: session.image_pair(current, previous, SampleRequest(0, spp, n), "path"),
        "adjoint": lambda n: session.adjoint(current, image, weight),
        "adjoint of a pair": lambda n: session.adjoint_pair(current, previous, pair, weight, weight),
        "primal and adjoint": lambda n: session.adjoint(
            current, session.image(current, SampleRequest(0, spp, n)).paths, weight
        ),
        **stock(problem, current, spp),
    }


def measure(resolution: int, grid: int, spp: int, repeats: int, sparse: bool) -> dict[str, Any]:
    """Medians and ratios; of a small dense core and a thin shell in a wide empty box where `sparse`."""
    problem = ur.gallery.problem("smoke", resolution=resolution, grid_resolution=grid, views=1, reference_spp=1)
    times = turns(contenders(problem, spp, sparse), repeats, warm=3)
    return {"median_ms": medians(times), "ratios": {name: ratio(times, *pair) for name, pair in RATIOS.items()}}


def run(resolution: int = 64, grid: int = 32, spp: int = 16, repeats: int = 9) -> dict[str, Any]:
    """A grid of smoke.

    Args:
        grid: voxels along a side
    """
    return measure(resolution, grid, spp, repeats, sparse=False)
