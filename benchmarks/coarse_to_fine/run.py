"""Coarse to fine: whether it pays, and what should become of states at a change of resolution, at equal steps.

    python benchmarks/coarse_to_fine/run.py [--problem smoke] [--method rcv] [--seeds 3]

Per problem and method: the finest resolution from the start, and three resolutions with all states begun anew ("reset"), all carried
("carry"), or those of the estimator carried and the optimizer's begun anew ("estimator", the default). The parameters' root mean square
errors at the end, and by how much the loss jumps: five steps after a change over one step before, the mean of both changes.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common import write

import unrender as ur
from unrender.methods import method

HERE = Path(__file__).resolve().parent
STATES = ("finest", "reset", "carry", "estimator")
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


def measure(problem: ur.Problem, by: str, changes: tuple[int, int], steps: int, seeds: int) -> dict[str, Any]:
    """Errors by parameter, and the loss's jumps."""
    errors: dict[str, list[float]] = {}
    jumps = []
    for seed in range(seeds):
        found = ur.optimize(problem, *method(by).start({}), steps, seed=seed)
        for key, error in problem.parameter_error(found.parameters).items():
            errors.setdefault(key, []).append(error)
        losses = [record["loss"] for record in found.history]
        jumps.append(np.mean([losses[change + AFTER] / losses[change - 1] for change in changes]))
    return {"errors": errors, "jump": float(np.mean(jumps))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", action="append", choices=list(PROBLEMS))
    parser.add_argument("--method", action="append")
    parser.add_argument("--seeds", type=int, default=3)
    asked = parser.parse_args()
    ur.use()
    found: dict[str, Any] = {}
    for name in asked.problem or PROBLEMS:
        options, changes, steps, methods = PROBLEMS[name]
        base = ur.gallery.problem(name, **options)
        found[name] = {"options": options, "changes": changes, "steps": steps, "methods": {}}
        for by in asked.method or methods:
            rows = found[name]["methods"][by] = {}
            for states in STATES:
                way = None if states == "finest" else ur.CoarseToFine(changes, states=states)
                parameters = [replace(p, coarse_to_fine=way) for p in base.parameters]
                problem = ur.Problem(
                    base.renderer, parameters, base.given_views, base.loss, base.max_depth, truth=base.truth, name=name
                )
                rows[states] = measure(problem, by, changes, steps, asked.seeds)
                print(name, by, states, rows[states], flush=True)
    write(HERE, {"seeds": asked.seeds, "problems": found})


if __name__ == "__main__":
    main()
