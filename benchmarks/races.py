"""Races between methods at equal time or steps: each tuned over a grid on seeds of its own, its best run on several others."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Estimator, Optimizer, Tree
from unrender.schedules import Constant, Schedule

TUNING_SEED = 1000
POINTS = 60
"""Measurements along a run."""
AT_END = 0.5
"""In place of `POINTS`: one measurement, at the end."""
UNIT = 0.01
"""Nominal learning rate of optimizers that a schedule scales: parameters with a learning rate of their own follow the schedule alone."""

Points = list[tuple[float, float, float]]
"""(seconds, samples, error) along a run."""
Runs = dict[str, list[Points]]
"""The runs of each method."""
Measure = Callable[[Tree], dict[str, float]]
"""Errors by name of some parameters, each relative to the start."""


@dataclass(frozen=True)
class Entrant:
    """A method at one cost per step, to be tuned by its learning rate.

    Attributes:
        name: unique in its race.
        group: what it is plotted as.
        estimator: where its gradients come from.
        optimizer: makes its optimizer from a learning rate.
        rates: those to try; a single one is taken as it is.
    """

    name: str
    group: str
    estimator: Estimator
    optimizer: Callable[..., Optimizer]
    rates: tuple[float, ...]


@dataclass(frozen=True)
class Scaled:
    """A schedule times a factor."""

    factor: float
    schedule: Schedule

    def __call__(self, step: float) -> float:
        return self.factor * self.schedule(step)


def scaled(optimizer: Callable[..., Optimizer], schedule: Schedule | None = None) -> Callable[[float], Optimizer]:
    """Return what makes an optimizer from a learning rate, to which all parameters' rates are in proportion."""
    return lambda rate: optimizer(UNIT, schedule=Scaled(rate / UNIT, schedule or Constant()))


def total(problem: ur.Problem) -> Measure:
    """Measure the parameters' errors relative to the start, averaged, under the name ""."""
    start = problem.parameter_error(problem.initial())
    return lambda parameters: {"": total_error(problem.parameter_error(parameters), start)}


class Recorder(ur.protocols.Callback):
    """Keep (seconds, samples, error) along a run for each error; measuring is no part of the seconds.

    Args:
        measure: errors of parameters.
        start: errors at the start.
        every: share of the budget between measurements; more than 1 for the end alone.
        clock: seconds; None for the run's own.
    """

    def __init__(
        self, measure: Measure, start: dict[str, float], every: float, clock: Callable[[], float] | None = None
    ):
        self.measure, self.every, self.due, self.clock, self.steps = measure, every, every, clock, 0
        self.points: dict[str, Points] = {name: [(0.0, 0.0, error)] for name, error in start.items()}
        self.since = self.spent = 0.0

    def on_start(self, run: Any) -> None:
        self.since = self.clock() if self.clock else 0.0

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        self.steps, self.spent = run.step, self.spent + self.clock() - self.since if self.clock else run.clock
        if run.stopped or run.progress() >= self.due:
            self.due = run.progress() + self.every
            for name, error in self.measure(run.full()).items():
                point = (self.spent, float(record["samples"]), error if math.isfinite(error) else math.inf)
                self.points[name].append(point)
        self.since = self.clock() if self.clock else 0.0


def follow(
    problem: ur.Problem,
    entrant: Entrant,
    rate: float,
    seed: int,
    measure: Measure | None = None,
    points: float = POINTS,
    clock: Callable[[], float] | None = None,
    ended: Callable[[ur.Result], None] = lambda result: None,
    **budget: Any,
) -> Recorder:
    """Return the record of one run. See `race` for the arguments."""
    measure = measure or total(problem)
    recorder = Recorder(measure, measure(problem.initial()), 1 / points, clock)
    optimizer = entrant.optimizer(rate)
    ended(ur.optimize(problem, entrant.estimator, optimizer, seed=seed, callbacks=[recorder], **budget))
    return recorder


def search(rates: tuple[float, ...], error: Callable[[float], float]) -> tuple[float, list[dict[str, float]]]:
    """The rate of the least error, and all that were tried. A best rate at an end of the grid extends it, thrice at most."""
    tried: dict[float, float] = {}

    def attempt(rate: float) -> None:
        found = error(rate)
        tried[rate] = found if math.isfinite(found) else math.inf

    for rate in rates:
        attempt(rate)
    factor = sorted(tried)[1] / sorted(tried)[0] if len(tried) > 1 else 1.0
    for _ in range(3):
        best = min(tried, key=tried.__getitem__)
        if factor == 1.0 or best not in (min(tried), max(tried)):
            break
        attempt(best / factor if best == min(tried) else best * factor)
    return min(tried, key=tried.__getitem__), [{"rate": rate, "error": e} for rate, e in sorted(tried.items())]


Setting = dict[str, Any]
"""Samples per pixel "spp", a learning "rate", and more."""


def grid(**values: Sequence[Any]) -> list[Setting]:
    """All settings of a grid, {name: values}."""
    return [dict(zip(values, each, strict=True)) for each in itertools.product(*values.values())]


def tune(name: str, settings: Sequence[Setting], error: Callable[[Setting], float]) -> tuple[Setting, list[Setting]]:
    """The setting of least error, and all that were tried, with their errors."""
    tried = []
    for setting in settings:
        found = error(setting)
        tried.append({**setting, "error": found if math.isfinite(found) else 1e9})
        print(f"  {name} {setting}: {found:.4f}", flush=True)
    return settings[min(range(len(tried)), key=lambda n: tried[n]["error"])], tried


def race(
    problem: ur.Problem,
    entrants: Sequence[Entrant],
    seeds: int,
    tuning_seeds: int = 1,
    measure: Measure | None = None,
    by: str = "",
    ended: Callable[[str, int, ur.Result], None] = lambda name, seed, result: None,
    points: float = POINTS,
    **budget: Any,
) -> dict[str, Any]:
    """Run every entrant, tuned, over seeds 0, 1, ..., in turns.

    Args:
        problem: what is raced on.
        entrants: the methods.
        seeds: runs of each.
        tuning_seeds: runs whose median error at the end chooses a rate.
        measure: errors by name; None for the one of `total`.
        by: the error that rates are chosen by.
        ended: called with the entrant's name, the seed and the result of each run but those that tune.
        points: measurements along a run.
        budget: seconds or steps of each run, and the clock of its seconds where it is not the run's own.

    Returns:
        By entrant: group, rate, tried, steps of each run, runs, and [median, least, greatest] at their ends under "final"; with
        `measure`, runs and ends by the error's name.
    """
    measure = measure or total(problem)

    def tuned(entrant: Entrant) -> tuple[float, list[dict[str, float]]]:
        def error(rate: float) -> float:
            tries = range(TUNING_SEED, TUNING_SEED + tuning_seeds)
            ends = [follow(problem, entrant, rate, seed, measure, AT_END, **budget).points[by][-1][2] for seed in tries]
            print(f"{problem.name} {entrant.name} rate {rate:g}: {np.median(ends):.4f}", flush=True)
            return float(np.median(ends))

        return (entrant.rates[0], []) if len(entrant.rates) == 1 else search(entrant.rates, error)

    chosen = {entrant.name: tuned(entrant) for entrant in entrants}
    found: dict[str, list[Recorder]] = {entrant.name: [] for entrant in entrants}
    for seed in range(seeds):
        for entrant in entrants:
            name = entrant.name

            def end(result: ur.Result, name: str = name, seed: int = seed) -> None:
                ended(name, seed, result)

            found[name].append(follow(problem, entrant, chosen[name][0], seed, measure, points, ended=end, **budget))
            print(f"{problem.name} {name} seed {seed}: final {found[name][-1].points[by][-1][2]:.4f}", flush=True)
    methods = {}
    for entrant in entrants:
        (rate, tried), recorders = chosen[entrant.name], found[entrant.name]
        runs: Any = {error: [recorder.points[error] for recorder in recorders] for error in recorders[0].points}
        final: Any = {error: median_and_range([run[-1][2] for run in each]) for error, each in runs.items()}
        entry = {"group": entrant.group, "rate": rate, "tried": tried, "steps": [each.steps for each in recorders]}
        methods[entrant.name] = entry | {"runs": runs.get("", runs), "final": final.get("", final)}
    return methods


def median_and_range(values: list[float]) -> list[float]:
    """Median, least and greatest."""
    return [float(np.median(values)), min(values), max(values)]


def total_error(errors: dict[str, float], start: dict[str, float]) -> float:
    """One number for several parameters: the mean of each one's error relative to where it began."""
    return float(np.mean([errors[key] / start[key] for key in errors]))


def relative_error(problem: ur.Problem) -> Callable[[dict[str, Any]], float]:
    """`total_error` of values of the problem's parameters."""
    start = problem.parameter_error(problem.initial())
    return lambda values: total_error(problem.parameter_error(values), start)


def tenths(runs: Runs, column: int) -> dict[str, list[float]]:
    """Each method's error, median over seeds, at each tenth of the seconds (column 0) or samples (1) that all reached."""
    end = min(run[-1][column] for found in runs.values() for run in found)
    where = end * np.arange(1, 11) / 10

    def middle(found: list[list[tuple[float, float, float]]]) -> np.ndarray:
        return np.median([np.interp(where, *np.array(run)[:, [column, 2]].T) for run in found], axis=0)

    return {name: middle(found).tolist() for name, found in runs.items()}


def over(runs: Runs, other: str) -> dict[str, dict[str, list[float]]]:
    """`tenths` over those of one of the methods, by time and by samples."""
    by = {"time": tenths(runs, 0), "samples": tenths(runs, 1)}
    return {
        axis: {name: [a / b for a, b in zip(errors, found[other], strict=True)] for name, errors in found.items()}
        for axis, found in by.items()
    }


def first_at(curve: Sequence[Sequence[float]], goal: float) -> float:
    """The time at which a curve (times, errors) reaches a goal, inf where it does not."""
    return next((time for time, error in zip(*curve, strict=True) if error <= goal), math.inf)


def reached(runs: list[list[tuple[float, float, float]]], error: float, column: int) -> float | None:
    """The median over runs of the seconds (column 0) or samples (1) at which the error is first at most `error`; None
    where half of the runs never get there."""
    firsts = [next((point[column] for point in run if point[2] <= error), math.inf) for run in runs]
    middle = float(np.median(firsts))
    return middle if math.isfinite(middle) else None
