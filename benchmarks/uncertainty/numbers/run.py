"""Coverage of the standard errors of numbers: how often the truth lies within one and two of them, over many seeds of three problems.

Each seed has a reference of its own with noise, and a run of `auto` of a fixed number of steps. The standard errors count the noise of
both. Runs without a run folder have those of the optimizer. Those with one have a least-squares test at the end, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.internals import parts
from benchmarks.runner import records
from benchmarks.runner.records import Record
from benchmarks.uncertainty.run import LEVELS, quantiles, with_own_references
from tests import few_numbers

MERGE = ("problems.*",)
QUICK: dict[str, Any] = {"problems": ("lamp",), "seeds": 2, "folder_seeds": 1, "steps": 10}
_SIZE, _DEPTH, _REFERENCE_SPP = 16, 4, 64
_LIMITS = (1.0, 2.0)
"""Numbers of standard errors of which coverage is counted."""


def problem(name: str) -> ur.Problem:
    """Return the problem of a name, without its reference."""
    scene, unknown = few_numbers.SMALL[name]()
    scene |= {"type": "scene", "sensor": parts.camera([0, 1.6, 4.2], [0, 0.4, 0], 40, _SIZE)}
    return ur.Problem(
        scene,
        [ur.Parameter(key, initial=initial) for key, (initial, _) in unknown.items()],
        [ur.View(np.ones((_SIZE, _SIZE, 3), np.float32))],
        max_depth=_DEPTH,
        truth={key: truth for key, (_, truth) in unknown.items()},
        name=name,
    )


def _scores(result: ur.Result) -> list[float] | None:
    """Return the errors of all numbers in their standard errors; None if a number has none."""
    if set(result.standard_error) < set(result.parameters):
        return None
    scores = [(x - result.truth[key]) / result.standard_error[key] for key, x in result.parameters.items()]
    return np.concatenate([np.ravel(x) for x in scores]).tolist()


def _coverage(scores: list[list[float]], seeds: int) -> dict[str, Any]:
    """Return the share of the numbers within each limit, and its standard error from the scatter over seeds."""
    z = np.abs(scores)
    inside = {f"{limit:g}": np.mean(z < limit, axis=1) for limit in _LIMITS}
    return {
        "runs": [len(scores), seeds],
        "inside": {limit: float(x.mean()) for limit, x in inside.items()},
        "error": {limit: float(x.std() / np.sqrt(len(x))) for limit, x in inside.items()},
        "std": float(np.std(scores)),
        "quantiles": np.quantile(scores, LEVELS).tolist(),
    }


def run(
    problems: tuple[str, ...] = ("lamp", "glass", "sun"), seeds: int = 100, folder_seeds: int = 20, steps: int = 16
) -> Iterator[dict[str, Any]]:
    """Coverage of each problem.

    Args:
        seeds: runs of each without a run folder
        folder_seeds: runs of each with one
    """
    for name in problems:
        made, found = problem(name), {}
        for kind, number in (("without a folder", seeds), ("with a folder", folder_seeds)):
            scores = []
            for seed in range(number):
                folder = records.scratch("uncertainty.numbers") if kind == "with a folder" else None
                of = with_own_references(made, _REFERENCE_SPP, seed)
                result = ur.optimize(of, steps=steps, seed=seed, run_directory=folder, progress=False)
                scores.append(_scores(result))
            if known := [z for z in scores if z is not None]:
                found[kind] = _coverage(known, number)
                print(name, kind, {key: x for key, x in found[kind].items() if key != "quantiles"}, flush=True)
        yield {"problems": {name: found}}


def table(record: Record) -> str:
    rows = []
    for name, kinds in record["problems"].items():
        for kind, entry in kinds.items():
            shares = [f"{entry['inside'][limit]:.0%} ± {entry['error'][limit]:.0%}" for limit in entry["inside"]]
            rows.append([name, kind, "{} of {}".format(*entry["runs"]), *shares, f"{entry['std']:.2f}"])
    text = f"{{steps}} steps, references of {_REFERENCE_SPP} samples per pixel. A seed's numbers count as one draw of the errors shown."
    head = "problem | runs | with standard errors | within 1 (68 % is right) | within 2 (95 %) | standard deviation of z (1)"
    return markdown.blocks(text.format(**record["settings"]), markdown.table(head, rows))


def plot(record: Record) -> figures.Figure:
    """Quantiles of the scores over those of the normal distribution."""
    return quantiles(record["problems"])
