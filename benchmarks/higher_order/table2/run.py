"""Table 2 of Wang et al.: seconds until the error has fallen by 90, 99 and 99.9 %, in the picture and in the parameters, over runs from
random starts.

    python benchmarks/higher_order/table2/run.py [--task MUG] [--method FR22] [--runs 20] [--seconds 1] [--seed 0]

Methods: the stock loop on path gradients where it applies (BUNNY, with Mitsuba's projective integrator, and TEXTURE); FR22, the smoothed
gradient of Fischer and Ritschel 2023 with Adam; CMA-ES; and ours: the gradient (OurG) with Adam, the Hessian (OurH) with Newton's
method, Hessian-vector products element by element (OurHVP) and from the aggregate (OurHVPA) with Newton-CG; and, beyond the paper,
gradient and products from the same renders (OurTogether). All render their perturbations by the same launches, with antithetic draws
and shared random numbers, and shrink σ as they go. Each is tuned on each task over a grid (`grid`), on starts of its own, for the
mean logarithm of its times; then the runs of all methods are done by turns.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from baseline import MITSUBA, mitsuba
from common import read, write
from race import GOALS, Descent, descend, numbers
from tasks import TASKS, Task, begin

import unrender as ur

HERE = Path(__file__).resolve().parent
TUNING = 2
"""Starts that a method is tuned on, numbered from 1000; TEXTURE, whose runs are all alike, takes one."""
FLOOR = 0.05
"""σ, learning rates and Newton's steps shrink to this share of their start, and no further."""
_MANY = 100
"""Parameters from which on a step is searched along one direction, and CMA-ES learns no covariances."""
_NEVER = 10.0
"""A goal that is not met counts as this many times the budget when methods are tuned."""

Config = dict[str, float]


@dataclass(frozen=True)
class Method:
    """A column of the table.

    Attributes:
        make: (task, number of parameters, configuration) to estimator and optimizer.
        grid: what is tried.
    """

    make: Callable[[Task, int, Config], tuple[Any, Any]]
    grid: dict[str, tuple[float, ...]]

    def configs(self) -> list[Config]:
        return [dict(zip(self.grid, values, strict=True)) for values in itertools.product(*self.grid.values())]


def _samples(n: int, c: Config) -> int:
    """Renders that an aggregate gradient takes."""
    usual = 8 if n <= 3 else 32 if n <= 32 else 256
    return max(round(c.get("samples", 1.0) * usual), 4)


def _shrinking(half_life: float, floor: float) -> Any:
    return ur.optimizers.schedules.Exponential(half_life, floor)


def _smoothed(task: Task, c: Config, samples: int, **more: Any) -> ur.SmoothedDerivatives:
    schedule = _shrinking(c["half_life"], FLOOR)
    return ur.SmoothedDerivatives(task.widths, samples, spp=task.spp, schedule=schedule, **{"joint": False, **more})


def _adam(task: Task, c: Config) -> Any:
    return ur.optimizers.Adam(c["rate"] * task.sigma, schedule=_shrinking(2 * c["half_life"], FLOOR))


def _newton(n: int, c: Config) -> dict[str, Any]:
    """Options of both Newton's methods: a trust radius of so much for each number, in units of σ, and steps that shrink."""
    return {"trust_radius": c["radius"] * math.sqrt(n), "schedule": _shrinking(c["steps"], FLOOR)}


def _fr22(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    return _smoothed(task, c, _samples(n, c), product=True), _adam(task, c)


def _gradient(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    return _smoothed(task, c, max(_samples(n, c) // n, 4), aggregate=False), _adam(task, c)


def _hessian(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    samples = max(2 * _samples(n, c) // n, 4)
    estimator = _smoothed(task, c, samples, order="hessian", aggregate=False, adaptive_annealing=True)
    return estimator, ur.optimizers.Newton(**_newton(n, c))


def _products(aggregate: bool) -> Callable[..., tuple[Any, Any]]:
    def make(task: Task, n: int, c: Config) -> tuple[Any, Any]:
        samples = _samples(n, c) if aggregate else max(_samples(n, c) // n, 4)
        estimator = _smoothed(task, c, samples, order="hvp", aggregate=aggregate, adaptive_annealing=True)
        return estimator, ur.optimizers.NewtonCG(
            iterations=1 if n > _MANY else int(c.get("iterations", min(n, 3))), **_newton(n, c)
        )

    return make


def _together(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    estimator = _smoothed(task, c, _samples(n, c), order="hvp", joint=True, adaptive_annealing=True)
    many = n > _MANY
    return estimator, ur.optimizers.NewtonCG(iterations=1 if many else min(n, 5), line=many, **_newton(n, c))


def _search(task: Task, n: int, c: Config) -> tuple[Any, Any]:
    population = None if c["population"] == 0 else int(c["population"])
    optimizer = ur.optimizers.CMAES(c["deviation"], population, diagonal=n > _MANY, learning_rate=task.sigma)
    return ur.LossValues(spp=task.spp), optimizer


_NEWTON_GRID = {"half_life": (6.0,), "steps": (30.0,), "radius": (0.5,)}
_HALF_OR_ALL = {"samples": (0.5, 1.0)}
METHODS = {
    "FR22": Method(_fr22, {"half_life": (10.0, 25.0), "rate": (0.15, 0.5), **_HALF_OR_ALL}),
    "CMA-ES": Method(_search, {"deviation": (0.5, 1.0), "population": (16,)}),
    "OurG": Method(_gradient, {"half_life": (25.0,), "rate": (0.15, 0.3)}),
    "OurH": Method(_hessian, _NEWTON_GRID),
    "OurHVP": Method(_products(False), _NEWTON_GRID),
    "OurHVPA": Method(_products(True), {**_NEWTON_GRID, **_HALF_OR_ALL}),
    "OurTogether": Method(_together, {**_NEWTON_GRID, "radius": (0.5, 0.8), **_HALF_OR_ALL}),
}
_RATES = {"rate": (0.03, 0.1, 0.3)}
_WIDE = {"half_life": (1e6,), "steps": (1e6,), "radius": (0.5,)}
_FAR = {"half_life": (6.0, 60.0), "steps": (30.0,), "radius": (0.8, 4.0)}
_CROWD = {"half_life": (30.0,), "steps": (80.0,), "radius": (0.25,), "samples": (0.5,)}
_SLOWER = {"half_life": (15.0,), "steps": (30.0,), "radius": (0.5,)}
OTHER_GRIDS: dict[tuple[str, str], dict[str, tuple[float, ...]]] = {
    **{("MUG", method): _SLOWER for method in ("OurHVPA", "OurTogether")},
    ("BOX10", "OurHVPA"): {**_CROWD, "iterations": (1.0,)},
    ("BOX10", "OurTogether"): _CROWD,
    ("BUNNY", "Mitsuba"): _RATES,
    ("BUNNY", "OurHVPA"): {"half_life": (12.0,), "steps": (60.0,), "radius": (0.5,), "samples": (0.5,)},
    **{("QUAD", method): _FAR for method in ("OurH", "OurHVP", "OurHVPA", "OurTogether")},
    ("QUAD", "FR22"): {"half_life": (25.0, 60.0), "rate": (0.5, 1.0, 2.0)},
    ("QUAD", "OurG"): {"half_life": (25.0, 60.0), "rate": (0.5, 1.0, 2.0)},
    ("TEXTURE", "Mitsuba"): {"rate": (0.03, 0.1)},
    ("TEXTURE", "FR22"): {"half_life": (60.0,), "rate": (0.2, 0.4)},
    ("TEXTURE", "CMA-ES"): {"deviation": (0.5,), "population": (16,)},
    ("TEXTURE", "OurG"): {"half_life": (60.0,), "rate": (0.2,)},
    ("TEXTURE", "OurHVP"): _WIDE,
    ("TEXTURE", "OurHVPA"): _WIDE,
    ("TEXTURE", "OurTogether"): _WIDE,
}
"""What is tried in place of a method's own grid."""
LEFT_OUT = {("TEXTURE", "OurH"): "a Hessian of 1024 × 1024 elements, each from perturbations of its own"}


def go(name: str, method: str, problem: ur.Problem, config: Config, run: int) -> Descent:
    """One run."""
    task = TASKS[name]
    unit = 1.0 if method == "CMA-ES" else config.get("rate")
    started = begin(problem, task, run, unit)
    if method == "Mitsuba":
        return mitsuba(name, started, config["rate"] * task.sigma, task.seconds)
    n = sum(value.size for value in problem.truth.values())
    return descend(started, *METHODS[method].make(task, n, config), task.seconds, run)


def tune(name: str, method: str, problem: ur.Problem) -> tuple[Config, list[dict[str, Any]]]:
    """The configuration of the least mean logarithm of times to the goals, and all that were tried."""
    task = TASKS[name]
    special = OTHER_GRIDS.get((name, method))
    configs = Method(METHODS["FR22"].make, special).configs() if special else METHODS[method].configs()
    tried = []
    if len(configs) == 1:
        return configs[0], tried
    for config in configs:
        scores = []
        for start in range(1000, 1000 + (1 if name == "TEXTURE" else TUNING)):
            found = go(name, method, problem, config, start)
            times = found.reached("parameter") + found.reached("image")
            scores += [math.log(max(min(t, _NEVER * task.seconds), 1e-3)) for t in times]
        tried.append({**config, "score": float(np.mean(scores))})
    best = min(tried, key=lambda entry: entry["score"])
    return {key: value for key, value in best.items() if key != "score"}, tried


def race(name: str, runs: int, first: int, chosen: list[str] | None) -> dict[str, Any]:
    """One row: every method that applies, or those `chosen`, tuned, over the runs."""
    task = TASKS[name]
    problem = task.problem()
    methods = [*(["Mitsuba"] if name in MITSUBA else []), *(m for m in METHODS if (name, m) not in LEFT_OUT)]
    if chosen:
        methods = [method for method in methods if method in chosen]
    found: dict[str, Any] = {}
    for method in methods:
        config, tried = tune(name, method, problem)
        found[method] = {"config": config, "tried": tried, "runs": []}
        print(f"{name} {method}: {config}", flush=True)
    for run in range(first, first + runs):
        for method in methods:
            descent = go(name, method, problem, found[method]["config"], run)
            found[method]["runs"].append(numbers(descent))
    for method, entry in found.items():
        entry["summary"], entry["curves"] = summarise(entry["runs"]), medians(entry["runs"])
        entry["seconds"], entry["command"] = task.seconds, " ".join(["python", *sys.argv])
        print(f"{name} {method}: {entry['summary']}", flush=True)
    return {
        "seconds": task.seconds,
        "sigma": task.widths,
        "spp": task.spp,
        "options": task.options,
        "methods": found,
    }


def keep(name: str, row: dict[str, Any], asked: argparse.Namespace) -> None:
    """Write a row into results.json, beside what others have written there meanwhile; methods that were not raced stay."""
    rows: dict[str, Any] = read(HERE)["tasks"] if (HERE / "results.json").is_file() else {}
    if asked.method:
        raced = {**rows.get(name, {}).get("methods", {}), **row["methods"]}
        row["methods"] = {method: raced[method] for method in ("Mitsuba", *METHODS) if method in raced}
    rows[name] = row
    tasks = {key: rows[key] for key in TASKS if key in rows}
    write(HERE, {"runs": asked.runs, "resolution": asked.resolution, "tasks": tasks})


def summarise(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians of the times (None where half of the runs or more never got there), and how many runs did."""
    found: dict[str, Any] = {}
    for which in ("parameter", "image"):
        times = np.array([run[which] for run in runs], float)
        medians = np.median(times, axis=0)
        found[which] = [float(t) if math.isfinite(t) else None for t in medians]
        found[f"{which}_count"] = np.isfinite(times).sum(axis=0).tolist()
    return found


def medians(runs: list[dict[str, Any]]) -> dict[str, list[list[float]]]:
    """Seconds and the median error there, in the picture and in the parameters; the runs give up their own curves for it."""
    found = {}
    for which in ("image", "parameter"):
        curves = [run.pop(f"{which}_curve") for run in runs]
        grid = np.geomspace(3e-3, max(curve[0][-1] for curve in curves), 100)
        values = np.median([np.interp(grid, *curve, right=curve[1][-1]) for curve in curves], axis=0)
        found[which] = [[float(f"{x:.4g}") for x in row] for row in (grid, values)]
    return found


def plot(results: dict[str, Any]) -> None:
    """Per task: median error over time, in the picture and in the parameters, log-log."""
    rows = results["tasks"]
    figure, axes = plt.subplots(len(rows), 2, figsize=(10, 2.9 * len(rows)), squeeze=False, layout="constrained")
    colour = dict(zip(["Mitsuba", *METHODS], plt.get_cmap("tab10").colors, strict=False))  # pyright: ignore[reportAttributeAccessIssue]
    for axis_row, (name, row) in zip(axes, rows.items(), strict=True):
        for axis, curve, what in zip(axis_row, ("image", "parameter"), ("picture", "parameters"), strict=True):
            for method, entry in row["methods"].items():
                axis.plot(*entry["curves"][curve], color=colour[method], label=method)
            for goal in GOALS:
                axis.axhline(goal, color="#bbb", lw=0.6)
            axis.set(
                title=f"{name}: {what}", xscale="log", yscale="log", xlabel="seconds", ylabel="error / at the start"
            )
            axis.set(xlim=(3e-3, row["seconds"]), ylim=(3e-4, 3))
        if len(row["methods"]) > 6 or name == next(iter(rows)):
            axis_row[0].legend(fontsize=6)
    figure.savefig(HERE / "figure.png", dpi=100)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", action="append", choices=list(TASKS))
    parser.add_argument("--method", action="append", choices=["Mitsuba", *METHODS], help="race these, keep the others")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="number of the first run: of its start and its draws")
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--seconds", type=float, default=1.0, help="factor of every task's budget")
    parser.add_argument("--threads", type=int, default=1, help="of Dr.Jit: one is best for pictures as small as these")
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        print(" ".join(["python", *sys.argv]), flush=True)
        ur.use()
        dr.set_thread_count(asked.threads)
        for name in asked.task or TASKS:
            task = TASKS[name]
            sized = {**task.options, "resolution": asked.resolution} if name != "QUAD" else task.options
            TASKS[name] = replace(task, options=sized, seconds=asked.seconds * task.seconds)
            keep(name, race(name, asked.runs, asked.seed, asked.method), asked)
    plot(read(HERE))


if __name__ == "__main__":
    main()
