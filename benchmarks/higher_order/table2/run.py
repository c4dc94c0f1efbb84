"""Times to converge (HO Table 2): seconds until the error has fallen by 90, 99 and 99.9 %, from random starts.

Errors are of the image and of the parameters. Methods: the stock loop on path gradients where it applies (BUNNY, with
Mitsuba's projective integrator, and TEXTURE); FR22, the smoothed gradient of Fischer and Ritschel 2023 with Adam;
CMA-ES; L-BFGS on the aggregate gradient; and the paper's: the gradient (OurG) with Adam, the Hessian (OurH) with
Newton's method, Hessian-vector products element by element (OurHVP) and from the aggregate (OurHVPA) with Newton-CG;
and, beyond the paper, gradient and products from the same renders (OurJoint). All render their perturbations by the
same launches, with antithetic draws and shared random numbers, and shrink σ as they go. Each is tuned on each task over
a grid (`methods.py`), on starts of its own, for the mean logarithm of its times; then the runs of all methods are done
in turns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.higher_order.table2.descents import Descent, descend, numbers
from benchmarks.higher_order.table2.methods import LEFT_OUT, METHODS, Config, configurations
from benchmarks.higher_order.table2.mitsuba_baseline import MITSUBA, mitsuba
from benchmarks.higher_order.table2.tasks import TASKS, Task, begin
from benchmarks.internals import dr
from benchmarks.runner.records import command

TUNING = 3
"""Starts that a method is tuned on, numbered from 1000; TEXTURE, whose runs are all alike, takes one."""
_NEVER = 10.0
"""A goal that is not met counts as this many times the budget when methods are tuned."""
ALL_METHODS = ("Mitsuba", *METHODS)
MERGE = ("tasks.*.methods",)
QUICK = {"task": ("MUG",), "method": ("FR22", "OurJoint"), "runs": 2, "resolution": 8, "seconds": 0.02}


def descend_by(name: str, task: Task, method: str, problem: ur.Problem, config: Config, number: int) -> Descent:
    """One run."""
    unit = 1.0 if method == "CMA-ES" else config.get("rate")
    started = begin(problem, task, number, unit)
    if method == "Mitsuba":
        return mitsuba(name, started, config["rate"] * task.sigma, task.seconds)
    n = sum(value.size for value in problem.truth.values())
    return descend(started, *METHODS[method].make(task, n, config), task.seconds, number)


def tune(name: str, task: Task, method: str, problem: ur.Problem) -> tuple[Config, list[dict[str, Any]]]:
    """The configuration of the least mean logarithm of times to the goals, and all that were tried."""
    configs, tried = configurations(name, method), []
    task = replace(task, seconds=task.tuned * task.seconds)
    if len(configs) == 1:
        return configs[0], tried
    for config in configs:
        scores = []
        for start in range(1000, 1000 + (1 if name == "TEXTURE" else TUNING)):
            found = descend_by(name, task, method, problem, config, start)
            times = found.reached("parameter") + found.reached("image")
            scores += [math.log(max(min(t, _NEVER * task.seconds), 1e-3)) for t in times]
        tried.append({**config, "score": float(np.mean(scores))})
    best = min(tried, key=lambda entry: entry["score"])
    return {key: value for key, value in best.items() if key != "score"}, tried


def race(name: str, task: Task, runs: int, first: int, chosen: tuple[str, ...]) -> dict[str, Any]:
    """One task: every method of `chosen` that applies, tuned, over the runs, in turns."""
    problem = task.problem()
    applies = {m for m in METHODS if (name, m) not in LEFT_OUT} | ({"Mitsuba"} if name in MITSUBA else set())
    found: dict[str, Any] = {}
    for method in (method for method in ALL_METHODS if method in applies and method in chosen):
        config, tried = tune(name, task, method, problem)
        found[method] = {"config": config, "tried": tried, "runs": []}
        print(f"{name} {method}: {config}", flush=True)
    for number in range(first, first + runs):
        for method, entry in found.items():
            entry["runs"].append(numbers(descend_by(name, task, method, problem, entry["config"], number)))
    for method, entry in found.items():
        entry["summary"], entry["curves"] = summarise(entry["runs"]), medians(entry["runs"])
        entry["seconds"], entry["command"] = task.seconds, command()
        print(f"{name} {method}: {entry['summary']}", flush=True)
    return {"sigma": task.widths, "spp": task.spp, "options": task.options, "methods": found}


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
    """Seconds and the median error there, of the image and of the parameters; the runs' own curves are removed."""
    found = {}
    for which in ("image", "parameter"):
        curves = [run.pop(f"{which}_curve") for run in runs]
        grid = np.geomspace(3e-3, max(curve[0][-1] for curve in curves), 100)
        values = np.median([np.interp(grid, *curve, right=curve[1][-1]) for curve in curves], axis=0)
        found[which] = [[float(f"{x:.4g}") for x in row] for row in (grid, values)]
    return found


def summarize(record: dict[str, Any]) -> dict[str, Any]:
    """Tasks and methods in the order of the paper's table."""
    tasks = {name: record["tasks"][name] for name in TASKS if name in record["tasks"]}
    return {
        "tasks": {
            name: {**task, "methods": {m: task["methods"][m] for m in ALL_METHODS if m in task["methods"]}}
            for name, task in tasks.items()
        }
    }


def run(
    task: tuple[str, ...] = tuple(TASKS),
    method: tuple[str, ...] = ALL_METHODS,
    runs: int = 20,
    seed: int = 0,
    resolution: int = 32,
    seconds: float = 1.0,
    threads: int = 1,
) -> Iterator[dict[str, Any]]:
    """A part per task.

    Args:
        method: those to race; the others' figures stay
        seed: number of the first run: of its start and its draws
        seconds: factor of every task's budget
        threads: of Dr.Jit: one is best for images as small as these
    """
    dr.set_thread_count(threads)
    for name in task:
        usual = TASKS[name]
        sized = {**usual.options, "resolution": resolution} if name != "QUAD" else usual.options
        chosen = replace(usual, options=sized, seconds=seconds * usual.seconds)
        yield {"tasks": {name: race(name, chosen, runs, seed, method)}}
