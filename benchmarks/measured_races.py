"""Races whose error is not the parameters' own: of images, or of what an image tells of the parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import unrender as ur
from benchmarks.internals import Optimizer, Tree
from benchmarks.races import TUNING_SEED, Entrant, median_and_range, search
from unrender.schedules import Constant, Schedule

UNIT = 0.01
"""The optimizers' nominal learning rate, which a schedule multiplies: the schedule scales parameters that have a learning rate of their
own with the others, which the optimizer's rate does not."""
POINTS = 24
"""Measurements along a run."""

Measure = Callable[[Tree], dict[str, float]]
"""Errors by name of some parameters, each relative to the start."""


@dataclass(frozen=True)
class Scaled:
    """A schedule times a factor."""

    factor: float
    schedule: Schedule

    def __call__(self, step: float) -> float:
        return self.factor * self.schedule(step)


def scaled(optimizer: Callable[..., Optimizer], schedule: Schedule | None = None) -> Callable[[float], Optimizer]:
    """Makes an optimizer from a learning rate, that all parameters' rates are in proportion to."""
    return lambda rate: optimizer(UNIT, schedule=Scaled(rate / UNIT, schedule or Constant()))


class ErrorRecorder(ur.protocols.Callback):
    """Keeps (seconds, samples, error) as a run goes, and at its end, for each error; its own time is not the run's."""

    def __init__(self, measure: Measure, start: dict[str, float], every: float):
        self.measure, self.every, self.due, self.steps = measure, every, every, 0
        self.points = {name: [(0.0, 0.0, error)] for name, error in start.items()}

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        """See `Callback.on_step`."""
        self.steps = run.step
        if run.stopped or run.progress() >= self.due:
            self.due = run.progress() + self.every
            for name, error in self.measure(run.parameters).items():
                self.points[name].append(
                    (run.clock, float(record["samples"]), error if math.isfinite(error) else math.inf)
                )


def follow(
    problem: ur.Problem, entrant: Entrant, measure: Measure, rate: float, seed: int, every: float, **budget: Any
) -> ErrorRecorder:
    """One run, its error recorded; `every` is a share of its budget, or more than 1 for its end alone."""
    recorder = ErrorRecorder(measure, measure(problem.initial()), every)
    ur.optimize(problem, entrant.estimator, entrant.optimizer(rate), seed=seed, callbacks=[recorder], **budget)
    return recorder


def compete(
    problem: ur.Problem, entrants: Sequence[Entrant], measure: Measure, by: str, seeds: int, **budget: Any
) -> dict[str, Any]:
    """Every entrant, tuned by the error `by` on a seed of its own, over seeds 0, 1, ..., in turns.

    Returns:
        By entrant: rate, tried; steps of each run; {error: runs} and {error: [median, least, greatest]} at their ends.
    """

    def tune(entrant: Entrant) -> tuple[float, list[dict[str, float]]]:
        def final(rate: float) -> float:
            points = follow(problem, entrant, measure, rate, TUNING_SEED, 2, **budget).points
            last = {name: along[-1][2] for name, along in points.items()}
            print(f"{problem.name} {entrant.name} rate {rate:g}: {last}", flush=True)
            return last[by]

        return search(entrant.rates, final)

    tuned = {entrant.name: tune(entrant) for entrant in entrants}
    recorded: dict[str, list[ErrorRecorder]] = {entrant.name: [] for entrant in entrants}
    for seed in range(seeds):
        for entrant in entrants:
            rate = tuned[entrant.name][0]
            recorded[entrant.name].append(follow(problem, entrant, measure, rate, seed, 1 / POINTS, **budget))
    return {entrant.name: _entry(entrant, *tuned[entrant.name], recorded[entrant.name]) for entrant in entrants}


def _entry(entrant: Entrant, rate: float, tried: Any, recorders: list[ErrorRecorder]) -> dict[str, Any]:
    runs = {name: [recorder.points[name] for recorder in recorders] for name in recorders[0].points}
    return {
        "group": entrant.group,
        "rate": rate,
        "tried": tried,
        "steps": [recorder.steps for recorder in recorders],
        "runs": runs,
        "final": {name: median_and_range([run[-1][2] for run in found]) for name, found in runs.items()},
    }
