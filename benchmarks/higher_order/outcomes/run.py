"""Starts and outcomes of the tasks of HO Table 2 (supplement): pictures of one run of FR22 and of OurHVPA on each.

The configurations are those that `higher_order.table2` has on record; the start is that of its first run. QUAD has
no picture. Also kept: the error of the parameters at the end, over that at the start.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.higher_order.table2.descents import WINDOW
from benchmarks.higher_order.table2.run import descend_by, recorded
from benchmarks.higher_order.table2.tasks import TASKS, begin
from benchmarks.internals import SampleRequest, arrays, dr, prepare, trees
from benchmarks.runner.records import Record

METHOD_NAMES = ("FR22", "OurHVPA")
_SPP = 256
QUICK = {"task": ("MUG",), "resolution": 8, "seconds": 0.02}


def picture(problem: ur.Problem, point: np.ndarray) -> np.ndarray:
    """The first view's image at parameters (n,), (H, W, 3)."""
    initial = problem.initial()
    session = prepare(problem, initial, None, derivatives=False)
    stacked = {key: value[None] for key, value in trees.unravel(point, initial).items()}
    return arrays.numpy(session.image_batch(stacked, SampleRequest(problem.views[0].sensor, _SPP, 1)))[0]


def run(
    task: tuple[str, ...] = tuple(name for name in TASKS if name != "QUAD"), resolution: int = 32, seconds: float = 0.5
) -> dict[str, Any]:
    """All tasks.

    Args:
        seconds: factor of every task's budget in Table 2
    """
    dr.set_thread_count(1)
    maps: dict[str, np.ndarray] = {}
    errors: dict[str, dict[str, float]] = {}
    for name in task:
        usual = TASKS[name]
        sized = replace(usual, options={**usual.options, "resolution": resolution}, seconds=seconds * usual.seconds)
        problem = sized.problem()
        maps[f"{name}|reference"] = np.asarray(problem.views[0].reference)
        errors[name] = {}
        for method in METHOD_NAMES:
            config = recorded(name)[method]["config"]
            started = begin(problem, sized, 0, config.get("rate"))
            found = descend_by(name, sized, method, problem, config, 0)
            errors[name][method] = float(found.parameter[-WINDOW:].mean())
            maps[f"{name}|start"] = picture(problem, trees.ravel(started.initial()))
            maps[f"{name}|{method}"] = picture(problem, found.end)
        print(name, errors[name], flush=True)
    return {"errors": errors, "maps": maps}


def table(record: Record) -> str:
    """Final errors of the runs whose outcomes the figure shows."""
    methods = list(next(iter(record["errors"].values())))
    rows = [[name, *(f"{errors[method]:.4f}" for method in methods)] for name, errors in record["errors"].items()]
    text = "Error of the parameters at the end, over that at the start."
    return markdown.blocks(text, markdown.table(" | ".join(["task", *methods]), rows))


def plot(record: Record) -> figures.Figure:
    """Per task: start, outcomes, reference."""
    rows = [
        {f"{name}: {kind}": record["maps"][f"{name}|{kind}"] for kind in ("start", *errors, "reference")}
        for name, errors in record["errors"].items()
    ]
    return figures.pictures(rows)
