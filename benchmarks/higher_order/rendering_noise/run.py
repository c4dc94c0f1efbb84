"""Smoothed derivatives under rendering noise (HO supplement): samples per pixel of perturbed renders, and where descents end.

On tasks of HO Table 2, with the configurations that `higher_order.table2` has tuned at its own samples per pixel, from the
same starts. Every descent takes equally many renders, so what changes is their noise alone; the images of a step share
their random numbers, as everywhere. Figures: root mean square error of the parameters at the end (mean of 10 steps),
over that at the start, and renders until it is a tenth.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks import figures, markdown
from benchmarks.higher_order.table2.descents import WINDOW
from benchmarks.higher_order.table2.run import descend_by, recorded
from benchmarks.higher_order.table2.tasks import TASKS
from benchmarks.internals import dr
from benchmarks.runner.records import Record

METHOD_NAMES = ("FR22", "OurHVPA", "OurJoint")
MERGE = ("tasks",)
QUICK = {"task": ("MUG",), "spp": (1, 2), "runs": 1, "renders": 30, "resolution": 8}


def one(name: str, problem: Any, method: str, spp: int, number: int, renders: int) -> dict[str, float]:
    """One run: its final error, and renders to a tenth of the first (infinite where it is not met)."""
    config = {**recorded(name)[method]["config"], "spp": float(spp)}
    task = replace(TASKS[name], seconds=math.inf)
    found = descend_by(name, task, method, problem, config, number, renders * spp)
    counted = replace(found, seconds=np.linspace(0, found.evaluations / spp, len(found.seconds)))
    return {"final": float(found.parameter[-WINDOW:].mean()), "renders": counted.reached("parameter")[0]}


def run(
    task: tuple[str, ...] = ("MUG", "BUNNY"),
    spp: tuple[int, ...] = (1, 4, 16, 64),
    runs: int = 5,
    renders: int = 600,
    resolution: int = 32,
) -> Iterator[dict[str, Any]]:
    """A part per task.

    Args:
        spp: samples per pixel of a render
        renders: of a descent
    """
    dr.set_thread_count(1)
    for name in task:
        problem = replace(TASKS[name], options={**TASKS[name].options, "resolution": resolution}).problem()
        methods = {
            method: {str(n): [one(name, problem, method, n, number, renders) for number in range(runs)] for n in spp}
            for method in METHOD_NAMES
        }
        for method, entry in methods.items():
            print(name, method, {count: float(np.median([r["final"] for r in rows])) for count, rows in entry.items()})
        yield {"tasks": {name: methods}}


def table(record: Record) -> str:
    """Final errors by samples per pixel, and renders to a tenth of the error."""
    counts, rows = [str(count) for count in record["settings"]["spp"]], []
    for name, methods in record["tasks"].items():
        for method, entry in methods.items():
            finals = [[run["final"] for run in entry[count]] for count in counts]
            times = [statistics.median(run["renders"] for run in entry[count]) for count in counts]
            cells = [f"{statistics.median(f):.4f} (to {max(f):.3f})" for f in finals]
            rows.append([name, method, *cells, *(f"{t:.0f}" if math.isfinite(t) else "—" for t in times)])
    head = ["task | method", *(f"final, {c} spp" for c in counts), *(f"to 90 %, {c} spp" for c in counts)]
    text = "{renders} renders, {runs} runs: median final error of the parameters (worst), median renders to a tenth."
    return markdown.blocks(text.format(**record["settings"]), markdown.table(" | ".join(head), rows))


def plot(record: Record) -> figures.Figure:
    """Final errors by samples per pixel."""
    panels = {
        name: {
            method: [
                ([float(count) for count in entry], [run["final"] for run in runs])
                for runs in zip(*entry.values(), strict=True)
            ]
            for method, entry in methods.items()
        }
        for name, methods in record["tasks"].items()
    }
    return figures.curves(panels, "samples per pixel", "final error of the parameters", log="xy")
