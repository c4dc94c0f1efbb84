"""The tasks of HO Table 2, with random starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Tree


@dataclass(frozen=True)
class Task:
    """One row of the table.

    Attributes:
        gallery: the problem's name there.
        options: of the problem.
        start: (generator, initial values, true values) to the start of a run, flattened in key order.
        sigma: scale of the smoothing that methods are tuned around, in units of the parameters.
        seconds: when a run is given up.
        spp: samples per pixel of a perturbed render.
        tuned: the share of `seconds` for which a configuration is tried.
        scales: {key: factor of σ, and of learning rates}, of parameters in other units than the rest.
    """

    gallery: str
    start: Callable[[np.random.Generator, np.ndarray, np.ndarray], np.ndarray]
    sigma: float
    seconds: float
    spp: int = 1
    tuned: float = 1.0
    options: dict[str, Any] = field(default_factory=dict)
    scales: dict[str, float] = field(default_factory=dict)

    @property
    def widths(self) -> dict[str, float]:
        """σ by parameter, for `SmoothedDerivatives`."""
        return {"*": self.sigma, **{key: factor * self.sigma for key, factor in self.scales.items()}}

    def problem(self) -> ur.Problem:
        """The task, from the gallery's own start."""
        return ur.gallery.problem(self.gallery, **self.options)


def begin(problem: ur.Problem, task: Task, run: int, rate: float | None = None) -> ur.Problem:
    """The same problem, on the same renderer, from the start of run number `run`.

    `rate` is the learning rate in units of σ that parameters with a σ of their own get; None where σ itself is the unit of steps.
    """
    initial = {key: np.array(value) for key, value in problem.initial().items()}
    vector = np.concatenate([value.ravel() for value in initial.values()]).astype(float)
    truth = np.concatenate([np.ravel(problem.truth[key]) for key in initial]).astype(float)
    point = task.start(np.random.default_rng([17, run]), vector, truth)
    moved: Tree = {}
    offset = 0
    for key, value in initial.items():
        moved[key] = point[offset : offset + value.size].reshape(value.shape)
        offset += value.size
    own = {} if rate is None else {key: rate * task.widths[key] for key in task.scales}
    parameters = [
        replace(p, initial=moved[p.key], bounds=problem.unknowns[p.key].bounds, learning_rate=own.get(p.key))
        for p in problem.parameters
    ]
    return problem.replaced(parameters=parameters)


def _around(spread: float) -> Callable[..., np.ndarray]:
    """The gallery's start, each number moved uniformly by up to `spread`."""
    return lambda rng, initial, truth: initial + rng.uniform(-spread, spread, initial.size)


def _quad(rng: np.random.Generator, initial: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Anywhere at a distance of 1 to 2."""
    angle = rng.uniform(0, 2 * np.pi)
    return rng.uniform(1, 2) * np.array([np.cos(angle), np.sin(angle)])


def _beside(rng: np.random.Generator, initial: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Anywhere in the middle of the image that does not touch the true place: distances of 0.45 to 1.2."""
    while True:
        point = rng.uniform(-1.3, 0.1, 2)
        if 0.45 < np.abs(point - truth).max() < 1.2:
            return point


def _hidden(rng: np.random.Generator, initial: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """With the handle out of sight or just in sight."""
    return rng.uniform(0.7, 1.9, 1)


def _bunny(rng: np.random.Generator, initial: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """A fraction of its size away on either side, turned by up to 40 degrees."""
    return np.concatenate([rng.choice([-1, 1], 2) * rng.uniform(0.1, 0.3, 2), rng.uniform(-0.7, 0.7, 1)])


def _grey(rng: np.random.Generator, initial: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """One grey."""
    return np.full(initial.size, rng.uniform(0.3, 0.7))


TASKS = {
    "QUAD": Task("quad", _quad, 0.5, 0.3),
    "BOX2": Task("box2", _beside, 0.5, 1.5),
    "BOX10": Task("box10", _around(0.08), 0.3, 3.5, spp=2),
    "MUG": Task("mug", _hidden, 0.6, 2.5),
    "SHADOW": Task("shadow", _around(0.2), 0.4, 1.5),
    "BUNNY": Task("bunny", _bunny, 0.2, 3.0, spp=4, scales={"bunny.rotation.y": 2.5}),
    "TEXTURE": Task("poster", _grey, 0.1, 42.0, spp=2, tuned=0.5, options={"reference_spp": 16384}),
}
"""By the paper's names."""
