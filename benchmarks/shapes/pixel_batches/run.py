"""Meshes from pictures by whole views, by some of them, and by uniform and adaptive mini-batches of pixels (Adaptive, Fig. 9).

Large steps and one rate for all vertices, plain images, equal processor time of all threads. Rates are tried on a seed of their own, for
each way of choosing pixels. `sphere-to-bunny` shows shading and silhouettes, and is judged by the surface; of `shadow-art` nothing is known
but the edges of two shadows, and it is judged by the pictures. Errors over the start's.

Variance: of the gradient at the start, by the coordinates of the large steps, summed, after some steps that adaptive probabilities learn
from; with parameters as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import Key, PixelSampler, with_preconditioner
from benchmarks.races import TUNING_SEED, search
from benchmarks.runner.records import Record
from benchmarks.timed_runs import measured, timed_run

MERGE = ("problems.*",)
QUICK: dict[str, Any] = {
    "seconds": 0.5, "seeds": 1, "resolution": 8, "subdivisions": 1, "views": 2, "pixels": 16, "rates": [0.01],
    "problems": ["sphere-to-bunny"], "repetitions": 2,
}  # fmt: skip
_LEARNING = 12
"""Steps before the variance is measured."""
_USUAL = 2048, 4
"""Pixels of a mini-batch and samples per pixel; others have entries of their own."""


def samplers(pixels: int, views: int) -> dict[str, PixelSampler]:
    """By name."""
    return {
        "whole views": ur.pixels.All(),
        "half of the views": ur.pixels.Views(max(views // 2, 1)),
        "uniform": ur.pixels.Uniform(pixels),
        "uniform, 4 times": ur.pixels.Uniform(4 * pixels),
        "adaptive": ur.pixels.Adaptive(pixels),
    }


def variance(problem: ur.Problem, sampler: PixelSampler, spp: int, repetitions: int) -> float:
    """Of the gradient at the start."""
    estimator, start = ur.PathGradient(ur.images.Plain(), sampler, spp=spp), problem.initial()
    state, found = estimator.init(problem, start), []
    (key,) = problem.faces
    for step in range(_LEARNING + repetitions):
        estimate, after = estimator.estimate(problem, start, state, Key(TUNING_SEED, step))
        if step < _LEARNING:
            state = after
        else:
            wrt_u = problem.coordinates.wrt_u(estimate.gradient, start)
            found.append(np.array(problem.coordinates.pull_back(wrt_u, {})[key], np.float64).ravel())
    return float(np.var(found, axis=0, ddof=1).sum())


def descend(
    problem: ur.Problem, sampler: PixelSampler, rate: float, spp: int, seconds: float, seed: int, steps: int | None
) -> dict[str, Any]:
    """The curve of one run, what it reached, and in which time."""
    estimator = ur.PathGradient(ur.images.Plain(), sampler, spp=spp)
    kept = timed_run(problem, seconds, seed, estimator, ur.optimizers.Adam(rate, uniform=True), steps=steps)
    return {**measured(problem, kept.found), "seconds": kept.seconds}


def run(
    seconds: float = 10.0,
    seeds: int = 3,
    problems: tuple[str, ...] = ("sphere-to-bunny", "shadow-art", "sphere-to-mesh"),
    resolution: int = 64,
    subdivisions: int = 3,
    views: int = 6,
    pixels: int = 2048,
    spp: int = 4,
    rates: tuple[float, ...] = (0.03, 0.1),
    repetitions: int = 40,
    only: tuple[str, ...] = (),
    steps: int | None = None,
) -> Iterator[dict[str, Any]]:
    """Every way.

    Args:
        seconds: of a run, of the processor
        views: how many, of problems that let it be chosen
        pixels: of a mini-batch
        rates: tried on a seed of its own
        repetitions: gradients that a variance is of
        steps: after which a run ends if its time has not; such runs have an entry of their own
    """
    found: dict[str, Any] = {}
    for name in problems:
        options = {} if name == "shadow-art" else {"views": views}
        problem = ur.gallery.problem(name, resolution=resolution, subdivisions=subdivisions, **options)
        (key,) = problem.faces
        problem = with_preconditioner(problem, ur.preconditioners.LargeSteps(4.0), key)
        what = "surface" if problem.has_truth else "pictures"
        label = name if (pixels, spp) == _USUAL else f"{name}, {pixels} pixels, {spp} spp"
        label += f", {steps} steps" if steps else ""
        found[label] = {"judged by": what, "views": len(problem.views), "seconds": seconds, "methods": {}}
        ways = samplers(pixels, len(problem.views))
        for way, sampler in ((way, ways[way]) for way in only or ways):

            def final(rate: float, sampler: PixelSampler = sampler, problem: ur.Problem = problem) -> float:
                found = descend(problem, sampler, rate, spp, seconds, TUNING_SEED, steps)
                return found["surface" if problem.has_truth else "pictures"]

            rate, _ = search(tuple(rates), final)
            runs = [descend(problem, sampler, rate, spp, seconds, seed, steps) for seed in range(seeds)]
            noise = variance(problem, sampler, spp, repetitions)
            found[label]["methods"][way] = {"rate": rate, "variance": noise, "runs": runs}
            print(name, way, rate, [float(np.round(one[what], 3)) for one in runs], noise, flush=True)
            yield {"problems": found}


def table(record: Record) -> str:
    """What was left of the errors, and the gradient's variance."""
    rows = []
    for problem, found in record["problems"].items():
        uniform = found["methods"].get("uniform", {}).get("variance", 0.0)
        for name, of in found["methods"].items():
            values = ([run[what] for run in of["runs"] if what in run] for what in ("surface", "pictures"))
            finals = (markdown.spread(each) if each else "–" for each in values)
            noise = f"{of['variance'] / uniform:.3g}" if uniform else "–"
            used = np.mean([run.get("seconds", found["seconds"]) for run in of["runs"]])
            budget = [f"{used:.3g} s", str(len(of["runs"]))]
            rows.append([problem, *budget, name, f"{of['rate']:g}", *finals, noise])
    text = (
        "Of the start's, after some seconds of the processor: median (least to greatest). "
        "Views of {resolution}², mini-batches of 2048 pixels, 4 spp, where no others are named. "
        "Variance of the gradient at the start, over that of uniform mini-batches."
    )
    head = "problem | seconds | seeds | pixels | rate | surface error | picture error | variance"
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))
