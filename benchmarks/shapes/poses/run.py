"""Poses of shapes by path gradients with boundaries, by perturbed renders, and by all memories together, from near and from far.

`box10` (where five squares lie), `mug` (how far a cup is turned) and `shadow` (where a ball is that only its shadow shows); the ball is a
mesh, which path gradients need. Near: what moves overlaps its place in the reference. Far: the gallery's start moved at random,
as in Table 2 of HO, on a plateau. Methods:

    paths         `PathGradient` with boundary terms, plain images, Adam
    smoothed      `SmoothedDerivatives` with products, Newton-CG, as method `smoothed`
    together      path gradients with boundary terms, a memory of images and one of gradients, and samples where the gradient's variance
                  is, MetaAdam: all ingredients of the method `hybrid` that poses alone admit. Its fourth, perturbed renders beside path
                  gradients of other parameters, needs other parameters
    gauss-newton  `GaussNewton` and `AveragedNewton`, what `auto` takes for cameras

Each is tuned over four configurations, for every problem and kind of start, on a start and random numbers of their own. Time is the
processor's, of all threads, without the first step. Errors are root mean squares over the elements, in their units.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import scene_description
from benchmarks.races import TUNING_SEED
from benchmarks.timed_runs import Kept, blind

MERGE = ("problems.*.*.methods",)
QUICK: dict[str, Any] = {
    "problems": ("shadow",), "starts": ("near",), "seconds": 0.2, "seeds": 1, "resolution": 8, "reference_spp": 4,
}  # fmt: skip
_FLOOR = 0.05
Config = dict[str, float]


@dataclass(frozen=True)
class Task:
    """A problem: σ, the scale that methods are tuned around; near and far starts, from a generator and the gallery's own; the error below
    which a run counts as converged."""

    sigma: float
    near: Callable[[np.random.Generator, np.ndarray], np.ndarray]
    far: Callable[[np.random.Generator, np.ndarray], np.ndarray]
    converged: float


def _within(spread: float) -> Callable[[np.random.Generator, np.ndarray], np.ndarray]:
    """Each number up to so far from the truth, which is 0."""
    return lambda rng, start: rng.uniform(-spread, spread, start.size)


def _around(spread: float) -> Callable[[np.random.Generator, np.ndarray], np.ndarray]:
    """The gallery's start, each number moved by up to so much."""
    return lambda rng, start: start + rng.uniform(-spread, spread, start.size)


TASKS = {
    "box10": Task(0.3, _within(0.12), _around(0.08), 0.02),
    "mug": Task(0.6, _within(0.2), lambda rng, start: rng.uniform(0.7, 1.2, 1), 0.03),
    "shadow": Task(0.4, _within(0.2), _around(0.15), 0.02),
}


def _paths(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    schedule = ur.schedules.Exponential(c["half_life"], _FLOOR)
    return ur.PathGradient(spp=4), ur.optimizers.Adam(c["rate"] * task.sigma, beta_2=0.99, schedule=schedule)


def _smoothed(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    schedule = ur.schedules.Exponential(c["half_life"], _FLOOR)
    sigma, samples = c["width"] * task.sigma, 16 if n <= 3 else 32
    estimator = ur.SmoothedDerivatives(sigma, samples, "hvp", spp=2, schedule=schedule)
    return estimator, ur.optimizers.NewtonCG(trust_radius=0.5 * np.sqrt(n), iterations=3)


def _together(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    image = ur.images.RecursiveControlVariate("primary")
    estimator = ur.MetaEstimator(coupled=True, spp=3, image=image, space="primary", pixels=ur.pixels.AdaptiveCounts())
    schedule = ur.schedules.Exponential(c["half_life"], _FLOOR)
    return estimator, ur.optimizers.MetaAdam(c["rate"] * task.sigma, schedule=schedule)


def _gauss_newton(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    estimator = ur.GaussNewton(64, 8, shift=c["shift"])
    return estimator, ur.optimizers.AveragedNewton(trust_radius=c["radius"])


Method = tuple[Callable[[Task, int, Config], tuple[Any, Any]], dict[str, tuple[float, ...]]]
METHODS: dict[str, Method] = {
    "paths": (_paths, {"rate": (0.05, 0.15), "half_life": (10, 40)}),
    "smoothed": (_smoothed, {"width": (0.3, 1.0), "half_life": (10, 40)}),
    "together": (_together, {"rate": (0.02, 0.06), "half_life": (10, 40)}),
    "gauss-newton": (_gauss_newton, {"shift": (0.3, 1.0), "radius": (4.0, 16.0)}),
}
"""What makes estimator and optimizer, and what is tried: four configurations each."""


def opened(name: str, resolution: int, reference_spp: int) -> ur.Problem:
    """The gallery's problem, with spheres that move as meshes."""
    found = ur.gallery.problem(name, resolution=resolution, reference_spp=reference_spp)
    unknown = [replace(each, bounds=found.unknowns[each.key].bounds) for each in found.parameters]
    return ur.Problem(
        lambda: scene_description(found),
        unknown,
        found.views,
        found.loss,
        found.max_depth,
        truth=found.truth,
        name=name,
    )


def begun(problem: ur.Problem, start: Callable[..., np.ndarray], seed: int) -> ur.Problem:
    """The same, from a start of its own."""
    rng = np.random.default_rng([29, seed])
    values = start(rng, np.concatenate([np.ravel(x) for x in problem.initial_values().values()]).astype(float))
    shapes = problem.shapes()
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])
    parts = {key: part.reshape(shapes[key]) for key, part in zip(shapes, np.split(values, ends[:-1]), strict=True)}
    unknown = [replace(each, initial=parts[each.key]) for each in problem.parameters]
    return problem.replaced(parameters=unknown)


def error(problem: ur.Problem, values: dict[str, np.ndarray]) -> float:
    """The root mean square over all elements."""
    return float(np.sqrt(np.mean(np.concatenate([np.ravel(values[k] - problem.truth[k]) for k in values]) ** 2)))


def descend(problem: ur.Problem, parts: tuple[Any, Any], seed: int, seconds: float) -> dict[str, Any]:
    """The error over seconds, and at the end."""
    kept = Kept(seconds)
    start = error(problem, problem.initial_values())
    ur.optimize(blind(problem), *parts, steps=1 << 20, seed=seed, callbacks=[kept])
    curve = [(0.0, start), *((second, error(problem, values)) for second, values in kept.found)]
    return {"curve": [list(x) for x in zip(*curve, strict=True)], "error": curve[-1][1], "start": start}


def tuned(
    make: Callable[[Config, int], dict[str, Any]], grid: dict[str, tuple[float, ...]]
) -> tuple[Config, list[Any]]:
    """The configuration of the least error on the seed of its own, and all that were tried."""
    tried = []
    for values in itertools.product(*grid.values()):
        config = dict(zip(grid, values, strict=True))
        found = make(config, TUNING_SEED)["error"]
        tried.append({**config, "error": found if np.isfinite(found) else 1e9})
    best = min(tried, key=lambda one: one["error"])
    return {key: best[key] for key in grid}, tried


def run(
    problems: tuple[str, ...] = tuple(TASKS),
    starts: tuple[str, ...] = ("near", "far"),
    methods: tuple[str, ...] = tuple(METHODS),
    seconds: float = 2.0,
    seeds: int = 3,
    resolution: int = 32,
    reference_spp: int = 1024,
) -> Iterator[dict[str, Any]]:
    """A part per problem and kind of start.

    Args:
        problems: of box10, mug and shadow
        starts: near and far
        methods: of paths, smoothed, together and gauss-newton
        seconds: of a run, of the processor
        seeds: of the runs that count
        resolution: film size
        reference_spp: of the references
    """
    for name in problems:
        problem, task = opened(name, resolution, reference_spp), TASKS[name]
        n = sum(int(np.prod(shape)) for shape in problem.shapes().values())
        for kind in starts:
            found: dict[str, Any] = {}
            for method in methods:
                parts, grid = METHODS[method]

                def make(config: Config, seed: int, parts: Any = parts, task: Task = task, kind: str = kind) -> Any:
                    asked = begun(problem, getattr(task, kind), seed)  # noqa: B023 (called within its turn)
                    return descend(asked, parts(task, n, config), seed, seconds)  # noqa: B023

                config, tried = tuned(make, grid)
                runs = [make(config, seed) for seed in range(seeds)]
                found[method] = {"config": config, "tried": tried, "runs": runs}
                print(name, kind, method, config, [round(one["error"], 4) for one in runs], flush=True)
            yield {"problems": {name: {kind: {"converged": task.converged, "methods": found}}}}
