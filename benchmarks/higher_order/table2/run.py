"""Times to converge (HO Table 2): seconds until the error has fallen by 90, 99 and 99.9 %, from random starts.

Errors are of the image and of the parameters. Methods: the stock loop on path gradients where it applies (BUNNY, with
Mitsuba's projective integrator, and TEXTURE); FR22, the smoothed gradient of Fischer and Ritschel 2023 with Adam;
CMA-ES; L-BFGS on the aggregate gradient; and the paper's: the gradient (OurG) with Adam, the Hessian (OurH) with
Newton's method, Hessian-vector products element by element (OurHVP) and from the aggregate (OurHVPA) with Newton-CG;
and, beyond the paper, gradient and products from the same renders (OurJoint), Gauss-Newton by differences of renders
after a search (OurGN), and `auto`, with the time of its plan, which has path gradients on TEXTURE and QUAD, and Gauss-Newton steps on
the others. The others render their perturbations by the same launches, with antithetic draws and shared random numbers,
and shrink σ as they go. Each but `auto` is tuned on each task over a grid (`methods.py`), on starts of its own, for the
mean logarithm of its times; then the runs of all methods are done in turns.
"""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.higher_order.table2 import published
from benchmarks.higher_order.table2.descents import Descent, Search, descend, numbers
from benchmarks.higher_order.table2.methods import LEFT_OUT, METHODS, Config, configurations
from benchmarks.higher_order.table2.mitsuba_baseline import MITSUBA, mitsuba
from benchmarks.higher_order.table2.tasks import TASKS, Task, begin
from benchmarks.internals import dr
from benchmarks.runner.records import Record, command, read

TUNING = 3
"""Starts that a method is tuned on, numbered from 1000; TEXTURE, whose runs are all alike, takes one."""
_NEVER = 10.0
"""A goal that is not met counts as this many times the budget when methods are tuned."""
ALL_METHODS = ("Mitsuba", *METHODS, "auto", *published.METHODS)
MERGE = ("tasks.*.methods",)
QUICK = {"task": ("MUG",), "method": ("FR22", "OurJoint"), "runs": 2, "resolution": 8, "seconds": 0.02}


def descend_by(
    name: str, task: Task, method: str, problem: ur.Problem, config: Config, number: int, evaluations: float = math.inf
) -> Descent:
    """One run, of so many `Descent.evaluations` at most where ours runs it."""
    unit = 1.0 if method == "CMA-ES" else config.get("rate")
    started = begin(problem, task, number, unit)
    if method == "Mitsuba":
        return mitsuba(name, started, config["rate"] * task.sigma, task.seconds)
    if method in published.METHODS:
        return published.descend(name, method, started, number)
    if method == "auto":
        return descend(started, "auto", None, task.seconds, number)
    n = sum(value.size for value in problem.truth.values())
    search = searching(task, started, config) if "draws" in config else None
    return descend(started, *METHODS[method].make(task, n, config), task.seconds, number, evaluations, search)


def searching(task: Task, problem: ur.Problem, config: Config) -> Search:
    """Return the search of a configuration, on a film of half the side."""
    side = int(problem.renderer.resolutions()[problem.views[0].sensor][0]) // 2
    small = _small(task.gallery, **{**task.options, "resolution": side})
    widths = [
        np.full(value.size, config["spread"] * task.widths.get(key, task.sigma)) for key, value in problem.truth.items()
    ]
    return Search(small, np.concatenate(widths), int(config["draws"]))


@functools.cache
def _small(name: str, **options: Any) -> ur.Problem:
    """Return a problem of the gallery, which compiles once."""
    return ur.gallery.problem(name, **options)


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


def recorded(name: str) -> dict[str, Any]:
    """Return the methods that the record has of a task."""
    record = read(Path(__file__).parent) or {"tasks": {}}
    return record["tasks"].get(name, {"methods": {}})["methods"]


def race(name: str, task: Task, runs: int, chosen: tuple[str, ...], known: dict[str, Any]) -> dict[str, Any]:
    """One task: every method of `chosen` that applies, tuned or as it is `known`, over the runs, in turns."""
    problem = task.problem()
    applies = {m for m in METHODS if (name, m) not in LEFT_OUT} | ({"Mitsuba"} if name in MITSUBA else set())
    applies |= {"auto"} | (set(published.METHODS) if name in published.SETTINGS else set())
    found: dict[str, Any] = {}
    for method in (method for method in ALL_METHODS if method in applies and method in chosen):
        config, tried = known[method] if method in known else tune(name, task, method, problem)
        found[method] = {"config": config, "tried": tried, "runs": []}
        print(f"{name} {method}: {config}", flush=True)
    for number in range(runs):
        for method, entry in found.items():
            entry["runs"].append(numbers(descend_by(name, task, method, problem, entry["config"], number)))
    for method, entry in found.items():
        entry["curves"], entry["seconds"], entry["command"] = medians(entry["runs"]), task.seconds, command()
        print(f"{name} {method}: {median_times(_times(entry, 'squared')).round(4)}", flush=True)
    return {"sigma": task.widths, "spp": task.spp, "options": task.options, "methods": found}


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
    resolution: int = 32,
    seconds: float = 1.0,
    tuned: bool = False,
) -> Iterator[dict[str, Any]]:
    """A part per task.

    Args:
        method: those to race; the others' figures stay
        seconds: factor of every task's budget
        tuned: takes the configurations of the record, where it has them
    """
    dr.set_thread_count(1)  # best for images as small as these
    for name in task:
        usual = TASKS[name]
        sized = {**usual.options, "resolution": resolution} if name != "QUAD" else usual.options
        chosen = replace(usual, options=sized, seconds=seconds * usual.seconds)
        known = {m: (entry["config"], entry["tried"]) for m, entry in recorded(name).items()} if tuned else {}
        yield {"tasks": {name: race(name, chosen, runs, method, known)}}


OURS = ("OurHVPA", "OurJoint")
"""Tuned as widely as FR22, and measured with it."""
RIVALS = ("FR22", "CMA-ES", "L-BFGS", "Mitsuba")
_HEAD = "image 90 % | 99 % | 99.9 % | parameters 90 % | 99 % | 99.9 %"
_PAIRS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    **{f"{rival} / {method}": ((rival,), (method,)) for method in OURS for rival in RIVALS},
    "FR22 / OurHVPA, both published": (("FR22, published",), ("OurHVPA, published",)),
    "best of others / best of ours": (RIVALS, (*OURS, "OurGN", "auto")),
}


def table(record: Record) -> str:
    """Seconds to each reduction of the error, and ratios of times by our goals and by the paper's."""
    entries = list(markdown.named(record["tasks"], "task", "methods", "method"))
    rows, papers = [], []
    for entry in entries:
        found = _times(entry, "parameter")
        there = " / ".join(map(str, np.isfinite(found)[:, 3:].sum(axis=0))) + f" of {len(found)}"
        cells = (f"{time:.3g}" if math.isfinite(time) else "—" for time in median_times(found))
        rows.append([entry["task"], entry["method"], *cells, there])
        if "squared" in entry["runs"][0]:
            found = _times(entry, "squared")
            pairs = zip(mean_times(found), np.isfinite(found).sum(axis=0), strict=True)
            cells = (f"{time:.3g} ({count})" if count else "—" for time, count in pairs)
            papers.append([entry["task"], entry["method"], *cells, len(found)])
    commands = dict.fromkeys(entry["command"] for entry in entries if "command" in entry)
    text = "Random starts, {resolution}²; median seconds of the processor, — where half the runs never got there."
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.table(f"task | method | {_HEAD} | runs that got there", rows),
        "By the paper's goals, squared errors of .1, .01 and .001 in single steps, and by its convention: mean seconds over all runs, "
        "where a goal that a run never reached counts as 0 s, and the number of runs that got there.",
        markdown.table(f"task | method | {_HEAD} | runs", papers),
        "Made by\n\n" + "\n".join(f"- `{command}`" for command in commands),
        "Ratios of times: means over the goals that both reached, with standard errors by a bootstrap over runs. Best of ours: OurHVPA, "
        f"OurJoint, OurGN and auto; of others: {', '.join(RIVALS)}.",
        "By our goals, median times:",
        _ratio_table(record["tasks"], "parameter", median_times),
        "By the paper's goals, median times:",
        _ratio_table(record["tasks"], "squared", median_times),
        "By the paper's goals and convention, 0 s where a goal was not reached:",
        _ratio_table(record["tasks"], "squared", mean_times),
    )


def _times(entry: dict[str, Any], which: str) -> np.ndarray:
    """Return the seconds of each run to the goals of the image and of the parameters, (runs, 6), inf where they were not reached."""
    return np.array([[*run["image"], *run[which]] for run in entry["runs"]], float)


def median_times(times: np.ndarray) -> np.ndarray:
    """Return the medians over runs, the last axis but one, inf where half of the runs or more never got there."""
    return np.median(times, axis=-2)


def mean_times(times: np.ndarray) -> np.ndarray:
    """Return the means over runs of times that are 0 where a goal was not reached, as the paper has them; inf where none reached it."""
    there = np.isfinite(times)
    return np.where(there.any(axis=-2), np.where(there, times, 0.0).mean(axis=-2), math.inf)


Statistic = Callable[[np.ndarray], np.ndarray]


def _ratio_table(tasks: dict[str, Any], which: str, statistic: Statistic, resamples: int = 1000) -> str:
    """Return a row per pair of methods: the mean ratio on each task and of all, with standard errors by a bootstrap over runs."""
    rows = []
    for name, sides in _PAIRS.items():
        if statistic is mean_times and len(sides[1]) > 1:
            continue  # whoever fails most would be the fastest
        cells, every, errors = [], [], []
        for methods in (task["methods"] for task in tasks.values()):
            known = ([m for n, m in methods.items() if n in side and which in m["runs"][0]] for side in sides)
            times = [[_times(method, which) for method in side] for side in known]
            ratios = _ratios(times, statistic).compressed().tolist() if all(times) else []
            if not ratios:
                cells.append("—")
                continue
            rng = np.random.default_rng(0)
            again = [[each[rng.integers(len(each), size=(resamples, len(each)))] for each in side] for side in times]
            every += ratios
            errors.append(_ratios(again, statistic))
            cells.append(f"{statistics.fmean(ratios):.2f}{_spread(errors[-1])} ({len(ratios)})")
        if every:
            spread = _spread(np.ma.concatenate(errors, axis=-1))
            middle = f"{statistics.fmean(every):.2f}{spread} ({statistics.geometric_mean(every):.2f})"
            rows.append([name, *cells, middle, len(every)])
    return markdown.table(" | ".join(["", *tasks, "all (geometric)", "goals"]), rows)


def _spread(ratios: Any) -> str:
    """Write the standard error of the mean ratio from resamples (B, n)."""
    return f" ± {ratios.mean(axis=-1).std():.2f}"


def _ratios(times: list[list[np.ndarray]], statistic: Statistic) -> Any:
    """Return the ratios of the least times of two sides, (..., 6), masked where one has not reached the goal."""
    theirs, ours = (np.ma.masked_invalid(np.min([statistic(each) for each in side], axis=0)) for side in times)
    return theirs / ours


def plot(record: Record) -> figures.Figure:
    """Per task: median error over seconds, in the image and in the parameters."""
    panels = {
        f"{name}: {kind}": {method: [entry["curves"][kind]] for method, entry in task["methods"].items()}
        for name, task in record["tasks"].items()
        for kind in ("image", "parameter")
    }
    return figures.curves(panels, "seconds", log="xy")
