"""One run of a method on a task, and its times to the goals."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, black_box, method, trees
from benchmarks.runner.timing import work_time

GOALS = (0.1, 0.01, 0.001)
"""Errors relative to the start: reductions of 90, 99 and 99.9 %."""

WINDOW = 10
"""Steps over which an error is averaged, as in the paper."""

_PATIENCE = 20.0
"""Wall-clock seconds that a run may take for each of the processor's."""

_LONGEST = 1000.0
"""Seconds of a run that its samples end."""

_BATCHES, _BETTER = 8, 0.4
"""Largest number of batches of a search, and the share of the start's loss that ends it."""

_IMAGES = 48
_IMAGE_SPP = 16


@dataclass(frozen=True)
class Descent:
    """A run: after how many seconds the parameters were where, and how far from the truth in the image and in themselves, relative to
    the start.

    Attributes:
        seconds: (T,), the start (0) first.
        parameter: (T,), root mean square error of all parameters.
        image: (T,), loss less that of the truth at the same random numbers; NaN where it was not measured.
        evaluations: samples per pixel of all renders, per view.
        end: where it ended, (n,), all parameters flattened in key order.
    """

    seconds: np.ndarray
    parameter: np.ndarray
    image: np.ndarray
    evaluations: float
    end: np.ndarray

    def reached(self, which: str) -> list[float]:
        """Return the seconds to each goal, inf where it was not met; "squared" stands for the squared error of the parameters in single
        steps, the paper's."""
        values = self.parameter**2 if which == "squared" else getattr(self, which)
        known = np.isfinite(values)
        seconds, values = self.seconds[known], values[known]
        if which == "parameter":
            kernel = np.ones(min(WINDOW, len(values)))
            count = np.convolve(np.ones(len(values)), kernel)[: len(values)]
            values = np.convolve(values, kernel)[: len(values)] / count
        return [float(seconds[np.argmax(values <= goal)]) if (values <= goal).any() else math.inf for goal in GOALS]


class Track(ur.protocols.Callback):
    """Keeps where a run went; ends it once the last goal is met in parameters, or the budget spent.

    Its clock is the processor's time of this process, warm-up and its own work left out: with one thread that is the time on a machine
    that has nothing else to do.

    Args:
        problem: with known truth.
        budget: seconds of the clock.
        most: samples.
    """

    def __init__(self, problem: ur.Problem, budget: float = math.inf, most: float = math.inf):
        self.problem, self.truth, start = problem, truth_of(problem), trees.ravel(problem.initial())
        self.points, self.seconds, self.samples = [start], [0.0], 0.0
        self.budget, self.most, self.clock, self.resumed = budget, most, 0.0, 0.0
        self.scale = float(np.sqrt(np.mean((start - self.truth) ** 2)))
        self.errors = [1.0]

    @property
    def arrived(self) -> bool:
        """Whether the last goal is met in the parameters."""
        return bool(np.mean(self.errors[-WINDOW:]) < 0.8 * GOALS[-1])

    def on_start(self, run: Any) -> None:
        self.resumed = work_time()

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        self.clock += work_time() - self.resumed
        self.add(trees.ravel(run.parameters), self.clock)
        self.samples = record["samples"]
        if self.arrived:
            run.stop("goal")
        if self.clock >= self.budget:
            run.stop("seconds")
        if self.samples >= self.most:
            run.stop("samples")
        self.resumed = work_time()

    def add(self, point: np.ndarray, seconds: float) -> None:
        self.points.append(point)
        self.seconds.append(seconds)
        self.errors.append(float(np.sqrt(np.mean((point - self.truth) ** 2))) / self.scale)

    def descent(self, work: float) -> Descent:
        """Return the run with its errors in the image at some steps, evenly spread over the logarithm of their number."""
        chosen = np.unique(np.round(np.geomspace(1, len(self.points), _IMAGES)).astype(int) - 1)
        evaluate = black_box(self.problem, self.problem.initial(), _IMAGE_SPP, Key(99))
        stack = np.stack([self.truth, *(self.points[index] for index in chosen)])
        losses = np.concatenate([evaluate(part) for part in np.array_split(stack, max(len(stack) // 8, 1))])
        image = np.full(len(self.points), np.nan)
        image[chosen] = np.abs(losses[1:] - losses[0])
        return Descent(
            np.array(self.seconds), np.array(self.errors), image / image[0], work, np.asarray(self.points[-1])
        )


@dataclass(frozen=True)
class Search:
    """Draws around the start, in batches of one launch each, until one has a much smaller loss in small pictures.

    Attributes:
        small: the problem on a small film.
        widths: standard deviation of each number, (n,).
        draws: points of a batch, the best so far among them.
    """

    small: ur.Problem
    widths: np.ndarray
    draws: int

    def best(self, start: np.ndarray, seed: int) -> tuple[np.ndarray, float]:
        """Return the best point, and the samples of all pictures."""
        losses_at = black_box(self.small, self.small.initial(), 1, Key(seed))
        generator, best, samples, first = np.random.default_rng([5, seed]), start, 0.0, math.inf
        for batch in range(_BATCHES):
            points = start + self.widths * generator.standard_normal((self.draws, start.size))
            points[0] = best
            losses = losses_at(points)
            samples += self.draws * size_of(self.small)
            best, first = points[np.argmin(losses)], losses[0] if batch == 0 else first
            if losses.min() < _BETTER * first:
                break
        return best, samples


def size_of(problem: ur.Problem) -> int:
    """Return the number of pixels of all views."""
    return sum(math.prod(problem.renderer.resolutions()[view.sensor]) for view in problem.views)


def descend(
    problem: ur.Problem,
    estimator: Any,
    optimizer: Any,
    seconds: float,
    seed: int,
    evaluations: float = math.inf,
    search: Search | None = None,
) -> Descent:
    """One run of the library's, of so many seconds and `Descent.evaluations` at most, the plan of `auto` not counted in the limit.

    Args:
        search: finds the first point, which counts as a step. Its samples count in the limit.
    """
    size = size_of(problem)
    track, earlier = Track(problem, seconds, evaluations * size), 0.0
    if search is not None:
        search.best(track.points[0], seed)  # compiles
        began = work_time()
        point, earlier = search.best(track.points[0], seed)
        track.clock = work_time() - began
        track.most -= earlier
        track.add(point, track.clock)
        problem = started_at(problem, point)
    if estimator == "auto":
        method("auto").plan(problem)  # compiles
        began = work_time()
        estimator = method("auto").plan(problem)
        track.clock = work_time() - began
        track.budget += track.clock
    longest = _PATIENCE * min(seconds, _LONGEST)
    ur.optimize(problem, estimator, optimizer, seconds=longest, seed=seed, callbacks=[track])
    return track.descent((earlier + track.samples) / size)


def started_at(problem: ur.Problem, point: np.ndarray) -> ur.Problem:
    """Return the problem with other initial values, (n,), flattened in key order."""
    values = trees.parts(point, problem.initial())
    return problem.replaced(parameters=[replace(p, initial=values[p.key]) for p in problem.parameters])


def truth_of(problem: ur.Problem) -> np.ndarray:
    """The true parameters, flattened in key order."""
    return np.concatenate([np.ravel(problem.truth[key]) for key in problem.initial()]).astype(float)


def numbers(descent: Descent) -> dict[str, Any]:
    """For results.json: times to the goals, and a curve of at most 120 points."""
    keep = np.unique(np.round(np.geomspace(1, len(descent.seconds), 120)).astype(int) - 1)
    return {
        **{which: descent.reached(which) for which in ("parameter", "image", "squared")},
        "steps": len(descent.seconds) - 1,
        "evaluations": descent.evaluations,
        "final": float(descent.parameter[-WINDOW:].mean()),
        "parameter_curve": [
            descent.seconds[keep].round(4).tolist(),
            [float(f"{e:.4g}") for e in descent.parameter[keep]],
        ],
        "image_curve": [
            descent.seconds[np.isfinite(descent.image)].round(4).tolist(),
            [float(f"{e:.4g}") for e in descent.image[np.isfinite(descent.image)]],
        ],
    }
