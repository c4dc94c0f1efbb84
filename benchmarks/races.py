"""Races between methods at equal time or steps: each tuned over a grid on seeds of its own, its best run on several others."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Estimator, Optimizer

TUNING_SEED = 1000


@dataclass(frozen=True)
class Entrant:
    """A method at one cost per step, to be tuned by its learning rate.

    Attributes:
        name: unique in its race.
        group: what it is plotted as.
        estimator: where its gradients come from.
        optimizer: makes its optimizer from a learning rate.
        rates: those to try.
    """

    name: str
    group: str
    estimator: Estimator
    optimizer: Callable[[float], Optimizer]
    rates: tuple[float, ...]


def descend(
    problem: ur.Problem,
    entrant: Entrant,
    rate: float,
    seed: int,
    seconds: float | None = None,
    steps: int | None = None,
    ended: Callable[[ur.Result], None] | None = None,
) -> list[tuple[float, float, float]]:
    """(seconds, samples, error) along one run: each parameter's RMSE relative to where it began, averaged over parameters.

    `ended` is called with the result.
    """
    result = ur.optimize(problem, entrant.estimator, entrant.optimizer(rate), seconds=seconds, steps=steps, seed=seed)
    if ended is not None:
        ended(result)
    start = problem.parameter_error(problem.initial())
    return [
        (h["seconds"], float(h["samples"]), total_error(h["parameter_error"], start))
        for h in result.history
        if "parameter_error" in h
    ]


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


def tune(
    problem: ur.Problem, entrant: Entrant, tuning_seeds: int, **budget: Any
) -> tuple[float, list[dict[str, float]]]:
    """The rate whose median final error is least, and all that were tried."""

    def error(rate: float) -> float:
        seeds = range(TUNING_SEED, TUNING_SEED + tuning_seeds)
        found = float(np.median([descend(problem, entrant, rate, seed, **budget)[-1][2] for seed in seeds]))
        print(f"{problem.name} {entrant.name} rate {rate:g}: {found:.4f}", flush=True)
        return found

    return search(entrant.rates, error)


def race(
    problem: ur.Problem,
    entrants: list[Entrant],
    seeds: int,
    tuning_seeds: int = 1,
    ended: Callable[[str, int, ur.Result], None] = lambda name, seed, result: None,
    **budget: Any,
) -> dict[str, Any]:
    """Every entrant, tuned, over seeds 0, 1, ..., in turns: {name: {"group", "rate", "tried", "runs", "final"}}.

    `ended` is called with the entrant's name, the seed and the result of each run but those that tune.
    """
    tuned = {entrant.name: tune(problem, entrant, tuning_seeds, **budget) for entrant in entrants}
    runs: Runs = {entrant.name: [] for entrant in entrants}
    for seed in range(seeds):
        for entrant in entrants:
            keep = functools.partial(ended, entrant.name, seed)
            runs[entrant.name].append(descend(problem, entrant, tuned[entrant.name][0], seed, ended=keep, **budget))
            print(f"{problem.name} {entrant.name} seed {seed}: final {runs[entrant.name][-1][-1][2]:.4f}", flush=True)
    return {
        entrant.name: {
            "group": entrant.group,
            "rate": tuned[entrant.name][0],
            "tried": tuned[entrant.name][1],
            "runs": runs[entrant.name],
            "final": median_and_range([run[-1][2] for run in runs[entrant.name]]),
        }
        for entrant in entrants
    }


def median_and_range(values: list[float]) -> list[float]:
    """Median, least and greatest."""
    return [float(np.median(values)), min(values), max(values)]


def total_error(errors: dict[str, float], start: dict[str, float]) -> float:
    """One number for several parameters: the mean of each one's error relative to where it began."""
    return float(np.mean([errors[key] / start[key] for key in errors]))


Runs = dict[str, list[list[tuple[float, float, float]]]]
"""Of each method, per seed: (seconds, samples, error) along the run."""


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


def reached(runs: list[list[tuple[float, float, float]]], error: float, column: int) -> float | None:
    """The median over runs of the seconds (column 0) or samples (1) at which the error is first at most `error`; None
    where half of the runs never get there."""
    firsts = [next((point[column] for point in run if point[2] <= error), math.inf) for run in runs]
    middle = float(np.median(firsts))
    return middle if math.isfinite(middle) else None
