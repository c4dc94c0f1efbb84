"""Races between methods at equal time or steps: each tuned over a grid on seeds of its own, its best run on several others."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from common import total_error

import unrender as ur
from unrender.estimators.base import Estimator
from unrender.optimizers.base import Optimizer

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
) -> list[tuple[float, float, float]]:
    """(seconds, samples, error) along one run: each parameter's RMSE relative to where it began, averaged over parameters."""
    result = ur.optimize(problem, entrant.estimator, entrant.optimizer(rate), seconds=seconds, steps=steps, seed=seed)
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
    problem: ur.Problem, entrants: list[Entrant], seeds: int, tuning_seeds: int = 1, **budget: Any
) -> dict[str, Any]:
    """Every entrant, tuned, over seeds 0, 1, ...: {name: {"group", "rate", "tried", "runs", "final"}}."""
    found: dict[str, Any] = {}
    for entrant in entrants:
        rate, tried = tune(problem, entrant, tuning_seeds, **budget)
        runs = [descend(problem, entrant, rate, seed, **budget) for seed in range(seeds)]
        final = [run[-1][2] for run in runs]
        found[entrant.name] = {
            "group": entrant.group,
            "rate": rate,
            "tried": tried,
            "runs": runs,
            "final": [float(np.median(final)), min(final), max(final)],
        }
        print(f"{problem.name} {entrant.name} rate {rate:g}: final {[round(f, 4) for f in final]}", flush=True)
    return found


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


def draw(axis: Any, entry: dict[str, Any], column: int, colour: Any, label: str, style: str = "-") -> None:
    """Median and range over seeds of the error, against seconds (column 0) or samples (1)."""
    end = min(run[-1][column] for run in entry["runs"])
    first = max(run[0][column] for run in entry["runs"])
    grid = np.linspace(first, end, 200)
    curves = np.stack([np.interp(grid, np.array(run)[:, column], np.array(run)[:, 2]) for run in entry["runs"]])
    axis.plot(grid, np.median(curves, 0), color=colour, label=label, ls=style)
    axis.fill_between(grid, curves.min(0), curves.max(0), color=colour, alpha=0.15, lw=0)


def colours(count: int) -> Any:
    """So many greys to oranges for a family of baselines."""
    return plt.get_cmap("YlOrBr")(np.linspace(0.3, 0.95, count))
