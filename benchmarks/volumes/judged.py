"""Races whose error is not the parameters' own: of pictures, or of what of the parameters a picture can tell."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from races import TUNING_SEED, Entrant, search

import unrender as ur
from unrender.core.trees import Tree
from unrender.optimizers.base import Optimizer
from unrender.schedules.functions import Constant, Schedule

UNIT = 0.01
"""The optimizers' own rate, which a schedule multiplies: where a problem gives a parameter a rate of its own, that scales it with the
others; a rate of the optimizer alone would leave it as it is."""
POINTS = 24

Measure = Callable[[Tree], dict[str, float]]
"""Errors by name of some parameters, each relative to the start."""


@dataclass(frozen=True)
class Scaled:
    """A schedule times a factor."""

    factor: float
    schedule: Schedule

    def __call__(self, step: float) -> float:
        return self.factor * self.schedule(step)


def at(optimizer: Callable[..., Optimizer], schedule: Schedule | None = None) -> Callable[[float], Optimizer]:
    """Makes an optimizer from a learning rate, that all parameters' rates are in proportion to."""
    return lambda rate: optimizer(UNIT, schedule=Scaled(rate / UNIT, schedule or Constant()))


class Watch(ur.Callback):
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
                told = error if math.isfinite(error) else math.inf
                self.points[name].append((run.clock, float(record["samples"]), told))


def follow(
    problem: ur.Problem, entrant: Entrant, measure: Measure, rate: float, seed: int, every: float, **budget: Any
) -> Watch:
    """One run, watched; `every` is a share of its budget, or more than 1 for its end alone."""
    watch = Watch(measure, measure(problem.initial()), every)
    ur.optimize(problem, entrant.estimator, entrant.optimizer(rate), seed=seed, callbacks=[watch], **budget)
    return watch


def compete(
    problem: ur.Problem, entrant: Entrant, measure: Measure, by: str, seeds: int, **budget: Any
) -> dict[str, Any]:
    """An entrant tuned by the error `by` on a seed of its own, and over seeds 0, 1, ...

    Returns:
        rate, tried; steps of each run; {error: runs} and {error: [median, least, greatest]} at their ends.
    """

    def final(rate: float) -> float:
        last = {
            name: p[-1][2]
            for name, p in follow(problem, entrant, measure, rate, TUNING_SEED, 2, **budget).points.items()
        }
        told = ", ".join(f"{name} {error:.4f}" for name, error in last.items())
        print(f"{problem.name} {entrant.name} rate {rate:g}: {told}", flush=True)
        return last[by]

    rate, tried = search(entrant.rates, final)
    watched = [follow(problem, entrant, measure, rate, seed, 1 / POINTS, **budget) for seed in range(seeds)]
    runs = {name: [watch.points[name] for watch in watched] for name in watched[0].points}
    ends = {name: [run[-1][2] for run in found] for name, found in runs.items()}
    print(f"{problem.name} {entrant.name} rate {rate:g}: {ends}", flush=True)
    return {
        "group": entrant.group,
        "rate": rate,
        "tried": tried,
        "steps": [watch.steps for watch in watched],
        "runs": runs,
        "final": {name: [float(np.median(e)), min(e), max(e)] for name, e in ends.items()},
    }
