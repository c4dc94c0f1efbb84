"""A sphere deformed into a body (HO Fig. 5): every vertex moved until the images match.

A perturbation of vertices rebuilds the mesh and renders every view, so renders are expensive and unknowns many: few steps
fit a budget. The true positions are not known (vertices may slide along the surface), so the error is that of the
images: the loss less that of noise alone, relative to the start. Seconds are the processor's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, black_box, dr, vectors
from benchmarks.runner.timing import work_time

SIGMA = 0.05
SAMPLES = 64
_SPP = 1
_EXACT_SPP = 64
_POINTS = 12
QUICK = {"seconds": 0.5, "subdivisions": 1, "resolution": 8}


def smoothed(samples: int = SAMPLES, **more: Any) -> ur.SmoothedDerivatives:
    """With the σ and the schedule of all methods."""
    schedule = ur.schedules.Exponential(60, 0.2)
    return ur.SmoothedDerivatives(SIGMA, samples, spp=_SPP, schedule=schedule, **more)


def cma_es(deviation: float) -> tuple[Any, Any]:
    """A search that begins with that deviation over 2, in units of σ."""
    optimizer = ur.optimizers.CMAES(0.5, SAMPLES, diagonal=True, learning_rate=deviation * SIGMA)
    return ur.estimators.LossValues(spp=_SPP), optimizer


def _fr22(_: int) -> tuple[Any, Any]:
    return smoothed(product=True), ur.optimizers.Adam(0.2 * SIGMA)


def _joint(n: int) -> tuple[Any, Any]:
    optimizer = ur.optimizers.NewtonCG(trust_radius=0.5 * math.sqrt(n), iterations=1, line=True)
    return smoothed(order="hvp", adaptive_annealing=True), optimizer


def _search(_: int) -> tuple[Any, Any]:
    return cma_es(1.0)


METHODS: dict[str, Callable[[int], tuple[Any, Any]]] = {"FR22": _fr22, "CMA-ES": _search, "OurJoint": _joint}


class _Track(ur.protocols.Callback):
    """Where a run went, by the processor's clock, which leaves out the warm-up."""

    def __init__(self, start: np.ndarray, budget: float):
        self.points, self.seconds, self.budget, self.resumed = [start], [0.0], budget, 0.0

    def on_start(self, run: Any) -> None:
        self.resumed = work_time()

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        self.seconds.append(self.seconds[-1] + work_time() - self.resumed)
        self.points.append(vectors.ravel(run.parameters))
        if self.seconds[-1] >= self.budget:
            run.stop("seconds")
        self.resumed = work_time()


def one(problem: ur.Problem, make: Callable[[int], tuple[Any, Any]], seconds: float, seed: int) -> dict[str, Any]:
    """One run: the images' loss at some steps."""
    start = vectors.ravel(problem.initial())
    track = _Track(start, seconds)
    estimator, optimizer = make(start.size)
    ur.optimize(problem, estimator, optimizer, seconds=20 * seconds, seed=seed, callbacks=[track])
    chosen = np.unique(np.linspace(0, len(track.points) - 1, _POINTS).round().astype(int))
    evaluate = black_box(problem, problem.initial(), _EXACT_SPP, Key(99))
    losses = evaluate(np.stack([track.points[index] for index in chosen]))
    return {
        "steps": len(track.points) - 1,
        "final": float(losses[-1] / losses[0]),
        "curve": [[round(track.seconds[index], 2) for index in chosen], (losses / losses[0]).round(4).tolist()],
    }


def run(seconds: float = 40.0, runs: int = 1, subdivisions: int = 2, resolution: int = 32) -> dict[str, Any]:
    """Every method, in turns.

    Args:
        seconds: processor time of a run
        subdivisions: of the sphere
    """
    dr.set_thread_count(1)
    problem = ur.gallery.problem("sphere-to-mesh", subdivisions=subdivisions, resolution=resolution)
    found: dict[str, Any] = {method: [] for method in METHODS}
    for number in range(runs):
        for method, make in METHODS.items():
            found[method].append(one(problem, make, seconds, number))
            print(method, found[method][-1], flush=True)
    return {"numbers": vectors.ravel(problem.initial()).size, "methods": found}
