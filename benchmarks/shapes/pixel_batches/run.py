"""A mesh from pictures by whole views, by some of them, and by uniform and adaptive mini-batches of pixels (Adaptive, Fig. 9).

`sphere-to-bunny`, large steps and one rate for all vertices, plain images, equal processor time of all threads. Rates are tried on a seed
of their own, for each way of choosing pixels. Adaptive probabilities are of the second moment of what path replay differentiates; the
boundary's derivatives, of what the silhouettes cover, are not part of it. Surface errors over the start's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import PixelSampler
from benchmarks.races import TUNING_SEED, search
from benchmarks.shapes.equal_time.run import Kept, blind, measured

QUICK: dict[str, Any] = {
    "seconds": 0.5, "seeds": 1, "resolution": 8, "subdivisions": 1, "views": 2, "pixels": 16, "rates": [0.01],
}  # fmt: skip


def samplers(pixels: int, views: int) -> dict[str, PixelSampler]:
    """By name."""
    return {
        "whole views": ur.pixels.All(),
        "half of the views": ur.pixels.Views(max(views // 2, 1)),
        "uniform": ur.pixels.Uniform(pixels),
        "adaptive": ur.pixels.Adaptive(pixels),
    }


def descend(
    problem: ur.Problem, sampler: PixelSampler, rate: float, spp: int, seconds: float, seed: int
) -> dict[str, Any]:
    """The curve of one run."""
    kept = Kept(seconds)
    estimator = ur.PathGradient(ur.images.Plain(), sampler, spp=spp)
    descent = ur.optimizers.Adam(rate, uniform=True)
    ur.optimize(blind(problem), estimator, descent, seconds=100 * seconds, seed=seed, callbacks=[kept])
    return measured(problem, kept.found)


def run(
    seconds: float = 10.0,
    seeds: int = 2,
    resolution: int = 64,
    subdivisions: int = 3,
    views: int = 6,
    pixels: int = 2048,
    spp: int = 4,
    strength: float = 4.0,
    rates: tuple[float, ...] = (0.01, 0.03),
) -> dict[str, Any]:
    """Every way.

    Args:
        seconds: of a run, of the processor
        seeds: of the runs that count
        views: how many
        pixels: of a mini-batch
        strength: of the large steps
        rates: tried on a seed of its own
    """
    problem = ur.gallery.problem("sphere-to-bunny", resolution=resolution, subdivisions=subdivisions, views=views)
    (key,) = problem.faces
    problem = problem.preconditioned({key: ur.preconditioners.LargeSteps(strength)})
    found: dict[str, Any] = {}
    for name, sampler in samplers(pixels, views).items():

        def final(rate: float, sampler: PixelSampler = sampler) -> float:
            return descend(problem, sampler, rate, spp, seconds, TUNING_SEED)["surface"]

        rate, _ = search(tuple(rates), final)
        runs = [descend(problem, sampler, rate, spp, seconds, seed) for seed in range(seeds)]
        found[name] = {"rate": rate, "runs": runs}
        print(name, rate, [float(np.round(one["surface"], 3)) for one in runs], flush=True)
    return {"methods": found}
