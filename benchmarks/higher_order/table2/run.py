"""Times to converge (HO Table 2): seconds until the error has fallen by 90, 99 and 99.9 %, from random starts.

Errors are of the image and of the parameters. Methods: the stock loop on path gradients where it applies (BUNNY, with
Mitsuba's projective integrator, and TEXTURE); FR22, the smoothed gradient of Fischer and Ritschel 2023 with Adam;
CMA-ES; L-BFGS on the aggregate gradient; and the paper's: the gradient (OurG) with Adam, the Hessian (OurH) with
Newton's method, Hessian-vector products element by element (OurHVP) and from the aggregate (OurHVPA) with Newton-CG;
and, beyond the paper, gradient and products from the same renders (OurJoint), Gauss-Newton by differences of renders
(OurGN), and on TEXTURE `auto`, which has path gradients as the stock loop has. The others render their perturbations by
the same launches, with antithetic draws and shared random numbers, and shrink σ as they go. Each but `auto` is tuned on
each task over a grid (`methods.py`), on starts of its own, for the mean logarithm of its times; then the runs of all
methods are done in turns.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.higher_order.table2 import published
from benchmarks.higher_order.table2.descents import Descent, descend, numbers
from benchmarks.higher_order.table2.methods import LEFT_OUT, METHODS, Config, configurations
from benchmarks.higher_order.table2.mitsuba_baseline import MITSUBA, mitsuba
from benchmarks.higher_order.table2.tasks import TASKS, Task, begin
from benchmarks.internals import dr
from benchmarks.races import first_at
from benchmarks.runner.records import Record, command

TUNING = 3
"""Starts that a method is tuned on, numbered from 1000; TEXTURE, whose runs are all alike, takes one."""
_NEVER = 10.0
"""A goal that is not met counts as this many times the budget when methods are tuned."""
AUTO = ("TEXTURE",)
"""Where `auto` takes path gradients, as Mitsuba's loop does."""
ALL_METHODS = ("Mitsuba", *METHODS, "auto", *published.METHODS)
MERGE = ("tasks.*.methods",)
QUICK = {"task": ("MUG",), "method": ("FR22", "OurJoint"), "runs": 2, "resolution": 8, "seconds": 0.02}


def descend_by(name: str, task: Task, method: str, problem: ur.Problem, config: Config, number: int) -> Descent:
    """One run."""
    unit = 1.0 if method == "CMA-ES" else config.get("rate")
    started = begin(problem, task, number, unit)
    if method == "Mitsuba":
        return mitsuba(name, started, config["rate"] * task.sigma, task.seconds)
    if method in published.METHODS:
        return published.descend(name, method, started, number)
    if method == "auto":
        return descend(started, "auto", None, task.seconds, number)
    n = sum(value.size for value in problem.truth.values())
    return descend(started, *METHODS[method].make(task, n, config), task.seconds, number)


def tune(name: str, task: Task, method: str, problem: ur.Problem) -> tuple[Config, list[dict[str, Any]]]:
    """The configuration of the least mean logarithm of times to the goals, and all that were tried."""
    if method in published.METHODS or method == "auto":
        return {}, []
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
    applies |= {"auto"} if name in AUTO else set()
    applies |= set(published.METHODS) if name in published.SETTINGS else set()
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


OURS = ("OurHVPA", "OurJoint")
"""Tuned as widely as FR22, and measured with it."""
GOALS = "image 90 % | 99 % | 99.9 % | parameters 90 % | 99 % | 99.9 %"


def table(record: Record) -> str:
    """Seconds to each reduction of the error, and ratios of times by our goals and by the paper's."""
    entries = list(markdown.named(record["tasks"], "task", "methods", "method"))
    rows = []
    for entry in entries:
        times = [*entry["summary"]["image"], *entry["summary"]["parameter"]]
        there = " / ".join(map(str, entry["summary"]["parameter_count"])) + f" of {len(entry['runs'])}"
        cells = ("—" if time is None else f"{time:.3g}" for time in times)
        rows.append([entry["task"], entry["method"], *cells, there])
    commands = dict.fromkeys(entry["command"] for entry in entries if "command" in entry)
    parts = [
        f"Random starts, {record['settings']['resolution']}²; median seconds of the processor, — where half the runs or more "
        "never got there.",
        markdown.table(f"task | method | {GOALS} | runs that got there", rows),
        "Made by\n\n" + "\n".join(f"- `{command}`" for command in commands),
    ]
    text = (
        "Times over those of one method alone, OurHVPA, the paper's, and OurJoint: means over the goals that both reached, with standard "
        "errors by a bootstrap over runs."
    )
    papers = (
        "By the paper's goals: squared errors of the parameters of .1, .01 and .001, that is RMSE of .316, .1 and .032, of single steps. "
        "Times at which the median curve of the runs reaches them; each cell is the mean ratio over the goals that both reached, with "
        "their number. Best of ours: OurHVPA, OurJoint, OurGN and auto; of others: FR22, CMA-ES, L-BFGS and Mitsuba."
    )
    return markdown.blocks(*parts, text, _apart(record["tasks"]), papers, _at_the_papers_goals(record["tasks"]))


_PAIRS = (
    ("FR22 / OurHVPA", ("FR22",), ("OurHVPA",)),
    ("FR22 / OurJoint", ("FR22",), ("OurJoint",)),
    ("CMA-ES / OurHVPA", ("CMA-ES",), ("OurHVPA",)),
    ("FR22 / OurHVPA, both published", ("FR22, published",), ("OurHVPA, published",)),
    ("best of others / best of ours", ("FR22", "CMA-ES", "L-BFGS", "Mitsuba"), (*OURS, "OurGN", "auto")),
)
_PAPERS_GOALS = {"image": (0.1, 0.01, 0.001), "parameter": tuple(math.sqrt(goal) for goal in (0.1, 0.01, 0.001))}


def _at_the_papers_goals(tasks: dict[str, Any]) -> str:
    """Return a row per pair of methods: ratios by task, and of all."""
    rows = []
    for name, theirs, ours in _PAIRS:
        ratios = {task: _ratios(entry["methods"], theirs, ours) for task, entry in tasks.items()}
        every = [ratio for values in ratios.values() for ratio in values]
        cells = [f"{statistics.fmean(values):.2f} ({len(values)})" if values else "—" for values in ratios.values()]
        middle = f"{statistics.fmean(every):.2f} ({statistics.geometric_mean(every):.2f})" if every else "—"
        rows.append([name, *cells, middle, len(every)])
    return markdown.table(" | ".join(["", *tasks, "all (geometric)", "goals"]), rows)


def _ratios(methods: dict[str, Any], theirs: tuple[str, ...], ours: tuple[str, ...]) -> list[float]:
    """Return the ratios of the least times of both sides, over the goals that both reached."""
    ratios = []
    for which, goals in _PAPERS_GOALS.items():
        for goal in goals:
            them, us = (
                [first_at(methods[name]["curves"][which], goal) for name in side if name in methods]
                for side in (theirs, ours)
            )
            if them and us and math.isfinite(min(them)) and math.isfinite(min(us)):
                ratios.append(min(them) / min(us))
    return ratios


def _apart(tasks: dict[str, Any]) -> str:
    """A row per rival and method: the mean of their ratios on each task, and of all, with the geometric mean."""
    rows = []
    for method, rival in itertools.product(OURS, ("FR22", "CMA-ES", "L-BFGS", "Mitsuba")):
        ratios = {name: _both(task["methods"], rival, method) for name, task in tasks.items()}
        every = [ratio for found in ratios.values() for ratio in found]
        cells = [
            f"{statistics.fmean(found):.2f} ± {_spread(tasks[name]['methods'], rival, method):.2f}" if found else "—"
            for name, found in ratios.items()
        ]
        middle = f"{statistics.fmean(every):.2f} ({statistics.geometric_mean(every):.2f})" if every else "—"
        rows.append([f"{rival} / {method}", *cells, middle, len(every)])
    return markdown.table(" | ".join(["", *tasks, "all (geometric)", "goals"]), rows)


def _both(methods: dict[str, Any], rival: str, method: str) -> list[float]:
    """The rival's times over the method's, of the goals that both reached in more than half of their runs."""
    if rival not in methods or method not in methods:
        return []
    theirs, ours = (
        [*entry["image"], *entry["parameter"]] for entry in (methods[m]["summary"] for m in (rival, method))
    )
    return [a / b for a, b in zip(theirs, ours, strict=True) if a is not None and b is not None]


def _spread(methods: dict[str, Any], rival: str, method: str, resamples: int = 1000) -> float:
    """Return the standard error of the mean of `_both`, by a bootstrap over the runs of both methods."""
    rng, found = np.random.default_rng(0), []
    times = [
        np.array([[*run["image"], *run["parameter"]] for run in methods[name]["runs"]], float)
        for name in (rival, method)
    ]
    for _ in range(resamples):
        theirs, ours = (np.median(each[rng.integers(len(each), size=len(each))], axis=0) for each in times)
        both = np.isfinite(theirs) & np.isfinite(ours)
        if both.any():
            found.append(float(np.mean(theirs[both] / ours[both])))
    return float(np.std(found))


def plot(record: Record) -> figures.Figure:
    """Per task: median error over seconds, in the image and in the parameters."""
    panels = {
        f"{name}: {kind}": {method: [entry["curves"][kind]] for method, entry in task["methods"].items()}
        for name, task in record["tasks"].items()
        for kind in ("image", "parameter")
    }
    return figures.curves(panels, "seconds", log="xy")
