"""Coarse to fine: whether it pays, and what should become of states at a change of resolution, at equal steps.

Per problem and method: the finest resolution from the start, and three resolutions with all states restarted ("reset"),
all kept ("carry"), or those of the estimator kept and the optimizer's restarted ("estimator", the default). The
parameters' root mean square errors at the end, and by how much the loss jumps: five steps after a change over one step
before, the mean of both changes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import method_parts

STATES: Any = ("finest", "reset", "carry", "estimator")
AFTER = 5
PROBLEMS: dict[str, tuple[dict[str, Any], tuple[int, int], int, tuple[str, ...]]] = {
    "indirect-room": (
        {"resolution": 32, "texture_resolution": 32, "reference_spp": 256, "loss": "L2"},
        (50, 100),
        150,
        ("plain", "rcv", "meta", "coupled"),
    ),
    "smoke": (
        {"resolution": 16, "grid_resolution": 16, "views": 4, "reference_spp": 256},
        (40, 80),
        120,
        ("plain", "rcv"),
    ),
}
QUICK = {"problem": ("indirect-room",), "method": ("rcv",), "seeds": 1, "tenth": True}


def measure(problem: ur.Problem, by: str, changes: tuple[int, int], steps: int, seeds: int) -> dict[str, Any]:
    """Errors by parameter, and the loss's jumps."""
    errors: dict[str, list[float]] = {}
    jumps = []
    for seed in range(seeds):
        found = ur.optimize(problem, *method_parts(by), steps=steps, seed=seed)
        for key, error in problem.parameter_error(found.parameters).items():
            errors.setdefault(key, []).append(error)
        losses = [record["loss"] for record in found.history]
        jumps.append(np.mean([losses[change + AFTER] / losses[change - 1] for change in changes]))
    return {"errors": errors, "jump": float(np.mean(jumps))}


def run(
    problem: tuple[str, ...] = tuple(PROBLEMS), method: tuple[str, ...] = (), seeds: int = 3, tenth: bool = False
) -> dict[str, Any]:
    """Every problem, method and treatment of states.

    Args:
        method: those to run (each problem's own)
        tenth: a tenth of the steps, for a trial
    """
    found: dict[str, Any] = {}
    for name in problem:
        options, changes, steps, methods = PROBLEMS[name]
        if tenth:
            changes, steps = (changes[0] // 10, changes[1] // 10), changes[1] // 10 + AFTER + 1
        base = ur.gallery.problem(name, **options)
        found[name] = {"options": options, "changes": changes, "steps": steps, "methods": {}}
        for by in method or methods:
            rows = found[name]["methods"][by] = {}
            for states in STATES:
                levels = None if states == "finest" else ur.CoarseToFine(changes, states=states)
                parameters = [replace(p, coarse_to_fine=levels) for p in base.parameters]
                made = base.replaced(parameters=parameters)
                rows[states] = measure(made, by, changes, steps, seeds)
                print(name, by, states, rows[states], flush=True)
    return {"problems": found}
