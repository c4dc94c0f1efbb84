"""The sphere that becomes a body (Wang et al., Fig. 5): every vertex of a sphere moved until its pictures are those of the body.

    python benchmarks/higher_order/table2/mesh.py [--seconds 40] [--runs 1] [--subdivisions 2]

A perturbation of vertices rebuilds the mesh and renders every view, so renders are dear and unknowns many: few steps fit a budget. Where
vertices belong is not known (they may slide along the surface), so the error is that of the pictures: the loss less that of noise alone,
relative to the start. Seconds are the processor's.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import write

import unrender as ur
from unrender.core import vectors
from unrender.core.random import Key
from unrender.estimators.loss_values import BlackBox

HERE = Path(__file__).resolve().parent / "mesh"
SIGMA = 0.05
SAMPLES = 64
_SPP = 1
_EXACT_SPP = 64
_POINTS = 12


def _smoothed(**more: Any) -> ur.SmoothedDerivatives:
    schedule = ur.optimizers.schedules.Exponential(60, 0.2)
    return ur.SmoothedDerivatives(SIGMA, SAMPLES, spp=_SPP, schedule=schedule, **more)


def _fr22(_: int) -> tuple[Any, Any]:
    return _smoothed(product=True), ur.optimizers.Adam(0.2 * SIGMA)


def _together(n: int) -> tuple[Any, Any]:
    optimizer = ur.optimizers.NewtonCG(trust_radius=0.5 * math.sqrt(n), iterations=1, line=True)
    return _smoothed(order="hvp", adaptive_annealing=True), optimizer


def _search(_: int) -> tuple[Any, Any]:
    return ur.LossValues(spp=_SPP), ur.optimizers.CMAES(0.5, SAMPLES, diagonal=True, learning_rate=SIGMA)


METHODS: dict[str, Callable[[int], tuple[Any, Any]]] = {"FR22": _fr22, "CMA-ES": _search, "OurTogether": _together}


class _Track(ur.Callback):
    """Where a run went, by the processor's clock, which leaves out the warm-up."""

    def __init__(self, start: np.ndarray, budget: float):
        self.points, self.seconds, self.budget, self.resumed = [start], [0.0], budget, 0.0

    def on_start(self, run: Any) -> None:
        self.resumed = time.process_time()

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        self.seconds.append(self.seconds[-1] + time.process_time() - self.resumed)
        self.points.append(vectors.ravel(run.parameters))
        if self.seconds[-1] >= self.budget:
            run.stop("seconds")
        self.resumed = time.process_time()


def one(problem: ur.Problem, method: str, seconds: float, seed: int) -> dict[str, Any]:
    """One run: the pictures' loss at some steps."""
    start = vectors.ravel(problem.initial())
    track = _Track(start, seconds)
    estimator, optimizer = METHODS[method](start.size)
    ur.optimize(problem, estimator, optimizer, seconds=20 * seconds, seed=seed, callbacks=[track])
    chosen = np.unique(np.linspace(0, len(track.points) - 1, _POINTS).round().astype(int))
    losses = BlackBox(problem, problem.initial(), _EXACT_SPP, Key(99)).losses(
        np.stack([track.points[index] for index in chosen])
    )
    return {
        "steps": len(track.points) - 1,
        "final": float(losses[-1] / losses[0]),
        "curve": [[round(track.seconds[index], 2) for index in chosen], (losses / losses[0]).round(4).tolist()],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--subdivisions", type=int, default=2)
    parser.add_argument("--resolution", type=int, default=32)
    asked = parser.parse_args()
    ur.use()
    dr.set_thread_count(1)
    options = {"subdivisions": asked.subdivisions, "resolution": asked.resolution}
    problem = ur.gallery.problem("sphere-to-mesh", **options)
    found: dict[str, Any] = {method: [] for method in METHODS}
    for run in range(asked.runs):
        for method in METHODS:
            found[method].append(one(problem, method, asked.seconds, run))
            print(method, found[method][-1], flush=True)
    numbers = vectors.ravel(problem.initial()).size
    write(HERE, {**options, "numbers": numbers, "runs": asked.runs, "seconds": asked.seconds, "methods": found})
    figure, axis = plt.subplots(figsize=(5.5, 4), layout="constrained")
    grid = np.linspace(0, asked.seconds, 100)
    for method, runs in found.items():
        axis.plot(grid, np.median([np.interp(grid, *run["curve"]) for run in runs], axis=0), label=method)
    axis.set(xlabel="seconds", ylabel="loss / at the start", yscale="log", title=f"sphere-to-mesh: {numbers} numbers")
    axis.legend()
    figure.savefig(HERE / "figure.png", dpi=110)


if __name__ == "__main__":
    main()
