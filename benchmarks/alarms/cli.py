"""`python -m benchmarks alarms`: run `auto` over every row of the suite at a small size, and list statuses and warnings.

A warning is true where the numbers beside it agree: the loss of a fresh picture, and each parameter's error where it is seen.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.runner import apart
from benchmarks.runner.records import scratch
from benchmarks.suite import scenes
from benchmarks.suite.run import FOREIGN, GALLERY, visible

__all__ = ["main"]

_SECONDS_OF_A_ROW = 400.0
_SIZES: dict[str, Any] = {"resolution": 32, "reference_spp": 256}
_TEXTURE = 32


def main(arguments: Sequence[str]) -> int:
    """Run the rows. The status is 1 where a run was not finished, or fell."""
    parser = argparse.ArgumentParser("python -m benchmarks alarms", description=__doc__)
    parser.add_argument("row", nargs="*", help="rows of the suite, such as `lamp` or `cbox, L2` (all)")
    parser.add_argument(
        "--assets", type=Path, help="folder of the scenes of others; their rows are left out without it"
    )
    parser.add_argument("--seconds", type=float, default=5.0, help="budget of a run (5)")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each row (1)")
    parser.add_argument(
        "--file", type=Path, default=scratch("alarms") / "runs.jsonl", help="where a line for each run is added"
    )
    given = parser.parse_args(arguments)
    ur.use()
    rows = given.row or [*GALLERY, *(FOREIGN if given.assets else ())]
    finished = True
    for row in rows:
        for seed in range(given.seeds):
            found = {
                "row": row,
                "seed": seed,
                **apart.call(_run, row, given.assets, given.seconds, seed, seconds=_SECONDS_OF_A_ROW),
            }
            finished &= found.get("status") == "finished"
            with given.file.open("a") as file:
                file.write(json.dumps(found) + "\n")
            print(f"{row}, seed {seed}: {found.get('status', 'fell')}", flush=True)
            for line in [*found.get("warnings", ()), *filter(None, [found.get("failed")])]:
                print(f"  {line}", flush=True)
    return int(not finished)


def _run(row: str, assets: Path | None, seconds: float, seed: int) -> dict[str, Any]:
    """Run a row."""
    if row in GALLERY:
        problem = ur.gallery.problem(row, **_SIZES)
    else:
        if assets is None:
            raise ur.InputError(f"row {row!r}: --assets names the folder of its scene")
        problem = scenes.problem(row, assets, _SIZES["resolution"], _TEXTURE, _SIZES["reference_spp"])
    result = ur.optimize(problem, "auto", seconds=seconds, seed=seed)
    seen = visible(problem)

    def errors(values: dict[str, np.ndarray]) -> dict[str, float]:
        return {
            key: float(
                np.sqrt(np.mean((values[key].reshape(truth.shape) - truth)[seen[key].reshape(truth.shape)] ** 2))
            )
            for key, truth in problem.truth.items()
        }

    return {
        "status": result.status,
        "steps": result.steps,
        "seconds": result.seconds,
        "warnings": list(result.warnings),
        "verification": dict(result.verification),
        "phases": dict(result.phases),
        "error where seen": {"start": errors(result.initial), "end": errors(dict(result.last or result.parameters))},
        "error": {"start": problem.parameter_error(result.initial), "end": problem.parameter_error(result.parameters)},
        "choices": list(result.choices),
    }
