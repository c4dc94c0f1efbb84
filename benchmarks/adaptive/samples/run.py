"""Variance times cost of the gradient over samples per pixel: of whole views, of a quarter of the pixels, and with a control variate.

A straight line of parameters is walked from the start, as Adam's first steps would go; at its end the gradients of several seeds are
compared: their variance, summed over all elements relative to each one's mean square over all seeds and numbers, which is what Adam's
steps see, and plain, times the paths of a step. With whole views and leave-one-out groups nothing is remembered, so only the end is
rendered; a control variate, which `auto` takes, and an importance map learn along the line. If only the number of samples
mattered, the product would be the same for all.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, element_scales

MERGE = ("problems.*",)
QUICK = {"problem": ("mirror-trio",), "spp": (1, 2), "runs": 4, "steps": 3, "resolution": 16}
RATE = 0.005
"""Length of a step along the line, in each element."""
PROBLEMS = (
    "ajar", "spiral", "indirect-room", "caustic", "mirror-trio", "plain-and-textured", "glossy-room", "poster", "two-planets",
    "sun-glossy", "lamp", "chalice", "sunlit-vase", "wall", "smoke", "tea", "three-bodies", "nerf-volume", "sphere-to-mesh",
    "bunny",
)  # fmt: skip


def line(problem: ur.Problem, steps: int) -> list[dict[str, Any]]:
    """Parameters along it, the start first."""
    start = problem.initial()
    gradient = ur.estimate(problem, ur.PathGradient(spp=16), seed=99).gradient
    signs = {key: problem.renderer.array(np.sign(np.array(g))) for key, g in gradient.items()}
    return [{key: x - (RATE * step) * signs[key] for key, x in start.items()} for step in range(steps)]


def gradients(problem: ur.Problem, estimator: Any, path: list[dict[str, Any]], runs: int) -> tuple[np.ndarray, float]:
    """(runs, n) gradients at the end of the line by as many seeds, and the paths of one."""
    rows, samples = [], 0
    for run in range(runs):
        state = estimator.init(problem, path[0])
        for step, at in enumerate(path[:-1]):
            _, state = estimator.estimate(problem, at, state, Key(run, step))
        estimate, _ = estimator.estimate(problem, path[-1], state, Key(run, len(path) - 1))
        pulled = problem.coordinates.pull_back(estimate.gradient, problem.coordinates.slopes(path[-1]))
        rows.append(np.concatenate([np.array(g).ravel() for g in pulled.values()]))
        samples = estimate.info["samples"]
    return np.array(rows, np.float64), float(samples)


def run(
    problem: tuple[str, ...] = PROBLEMS,
    spp: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64),
    runs: int = 24,
    steps: int = 8,
    resolution: int = 24,
) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        problem: of the gallery
        spp: samples per pixel
        runs: seeds for each
        steps: of the line
        resolution: film size
    """
    for name in problem:
        made = ur.gallery.problem(name, resolution=resolution, reference_spp=256)
        walked = line(made, steps)
        found: dict[tuple[str, int], tuple[np.ndarray, float]] = {}
        for number in spp:
            drawn = ur.pixels.Adaptive(max(1, made.pixels // 4), samples=256)
            found["whole", number] = gradients(made, ur.PathGradient(spp=number), walked[-1:], runs)
            if number <= 16:
                found["drawn", number] = gradients(made, ur.PathGradient(pixels=drawn, spp=number), walked, runs)
                image = ur.images.RecursiveControlVariate()
                found["rcv", number] = gradients(made, ur.PathGradient(image, spp=number), walked, runs)
        squares = np.mean([np.square(rows).mean(axis=0) for rows, _ in found.values()], axis=0)
        weights = np.square(element_scales(walked[-1], squares))
        entry: dict[str, Any] = {}
        for (kind, number), (rows, samples) in found.items():
            variance = rows.var(axis=0, ddof=1)
            products = [float(variance @ w) * samples / made.pixels for w in (np.ones(len(weights)), weights)]
            entry.setdefault(kind, {})[str(number)] = products
        print(name, entry, flush=True)
        yield {"problems": {name: entry}}
