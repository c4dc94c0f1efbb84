"""The toy problem of meta-estimation (Meta Fig. 2): the rate of an exponential distribution, 32 samples a step.

Adam on plain gradients (32 samples in leave-one-out groups); the paper's form with MetaAdam, its samples split in half
(16 proportional, 16 difference samples) and three to one, and with Adam as the paper warns; the coupled form (32
samples). Each is tuned by its RMSE over other seeds, once for 200 steps and once for 400.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import RATE
from benchmarks.runner.records import Record

RENDERS = False
HORIZONS = (200, 400)
ADAM_RATES = tuple(float(r) for r in np.geomspace(0.002, 0.05, 9).round(5))
META_RATES = tuple(float(r) for r in np.geomspace(0.0003, 0.02, 10).round(5))
ADAM, META = ur.optimizers.Adam, ur.optimizers.MetaAdam
METHODS: dict[str, tuple[Any, Any, tuple[float, ...]]] = {
    "adam": (ur.PathGradient(spp=32), ADAM, ADAM_RATES),
    "meta 24 + 8, naive": (ur.MetaEstimator(24, 8), ADAM, ADAM_RATES),
    "meta 16 + 16": (ur.MetaEstimator(16, 16), META, META_RATES),
    "meta 24 + 8": (ur.MetaEstimator(24, 8), META, META_RATES),
    "coupled": (ur.MetaEstimator(coupled=True, spp=32), META, META_RATES),
}
FIRST_TUNING_SEED = 10_000
QUICK = {"seeds": 2, "tuning_seeds": 1, "steps": (4, 8), "rates": 2}


class Trace(ur.protocols.Callback):
    """The rate after every step, and what the estimator said of it."""

    def __init__(self) -> None:
        self.rates: list[float] = []
        self.gradients: list[float] = []
        self.deviations: list[float] = []

    def on_step(self, run: Any, record: Any) -> None:
        del record
        self.rates.append(float(run.parameters[RATE]))
        self.gradients.append(float(run.estimate.gradient[RATE]))
        if run.estimate.variance is not None:
            self.deviations.append(float(run.estimate.variance[RATE]) ** 0.5)


def follow(problem: ur.Problem, method: str, rate: float, steps: int, seeds: range) -> list[Trace]:
    """One run per seed."""
    estimator, optimizer, _ = METHODS[method]
    traces = []
    for seed in seeds:
        traces.append(Trace())
        ur.optimize(problem, estimator, optimizer(rate), steps=steps, seed=seed, callbacks=[traces[-1]])
    return traces


def errors(problem: ur.Problem, traces: list[Trace]) -> np.ndarray:
    """RMSE over runs at each step."""
    rates = np.array([trace.rates for trace in traces])
    return np.sqrt(np.mean((rates - problem.truth[RATE]) ** 2, axis=0))


def run(
    seeds: int = 60, tuning_seeds: int = 16, steps: tuple[int, ...] = HORIZONS, rates: int | None = None
) -> dict[str, Any]:
    """Tuned errors of every method at both numbers of steps.

    Args:
        steps: numbers of steps, each tuned for
        rates: how many of the learning rates are tried
    """
    problem, tuning = ur.gallery.problem("exponential"), range(FIRST_TUNING_SEED, FIRST_TUNING_SEED + tuning_seeds)
    found: dict[str, Any] = {}
    for method, (_, _, grid) in METHODS.items():
        tried = {rate: errors(problem, follow(problem, method, rate, max(steps), tuning)) for rate in grid[:rates]}
        entry: dict[str, Any] = {"tried": {rate: [float(e[h - 1]) for h in steps] for rate, e in tried.items()}}
        for horizon in steps:
            last = horizon - 1
            best = min(tried, key=lambda rate, last=last: float(tried[rate][last]))
            traces = follow(problem, method, best, max(steps), range(seeds))
            error = errors(problem, traces)
            entry[str(horizon)] = {
                "rate": best,
                "rmse": float(error[last]),
                "curve": error.tolist(),
                "runs": [trace.rates for trace in traces[:20]],
                "gradients": traces[0].gradients,
                "deviations": traces[0].deviations,
            }
            print(f"{method}, {horizon} steps: rate {best:g}, rmse {error[last]:.5f}", flush=True)
        found[method] = entry
    for method in found:
        for horizon in map(str, steps):
            found[method][horizon]["of_adam"] = found[method][horizon]["rmse"] / found["adam"][horizon]["rmse"]
    return {"methods": found}


def table(record: Record) -> str:
    horizons = [str(steps) for steps in record["settings"]["steps"]]
    cells = (f"{{{n}[rmse]:.5f}} | {{{n}[of_adam]:.2f}} | {{{n}[rate]:g}}" for n in horizons)
    return markdown.blocks(
        f"{record['settings']['seeds']} runs; each method tuned for each horizon on other seeds.",
        markdown.records(
            " | ".join(["method", *(f"RMSE after {n} steps | of Adam's | rate" for n in horizons)]),
            " | ".join(["{method}", *cells]),
            markdown.named(record["methods"], "method"),
        ),
    )


def plot(record: Record) -> figures.Figure:
    """The rate over the steps, with the range of 20 runs, and its RMSE."""
    horizon = str(record["settings"]["steps"][0])
    methods = {f"{name}, rate {entry[horizon]['rate']:g}": entry[horizon] for name, entry in record["methods"].items()}
    panels = {
        "rate, 20 runs": {name: figures.over_steps(*entry["runs"]) for name, entry in methods.items()},
        f"RMSE, tuned for {horizon} steps": {
            name: figures.over_steps(entry["curve"]) for name, entry in methods.items()
        },
    }
    return figures.curves(panels, "step", "")
