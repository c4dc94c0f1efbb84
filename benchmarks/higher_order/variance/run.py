"""Variance reductions of smoothed derivatives (HO section 3 and beyond): gradient, Hessian and its products.

On `quad`, `box10` and `mug`, at the start. "plain": each element from its own kernel, nothing else. Then one variance
reduction at a time on top of it, and all together. The figure is the variance summed over elements times the
evaluations that all elements took together, over that of "plain": below 1 it pays. Variance is over runs, of estimates
at fixed random numbers of the renders.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import Key, black_box, trees
from benchmarks.runner.records import Record

SIGMA = {"quad": 0.3, "box10": 0.3, "mug": 0.5}
PLAIN = {"aggregate": False, "antithetic": False, "baseline": False, "low_discrepancy": False}
CUTS: dict[str, dict[str, bool]] = {
    "plain": {},
    "aggregate": {"aggregate": True},
    "antithetic": {"antithetic": True},
    "baseline": {"baseline": True},
    "antithetic and baseline": {"antithetic": True, "baseline": True},
    "low-discrepancy": {"low_discrepancy": True},
    "all": {"aggregate": True, "antithetic": True, "baseline": True, "low_discrepancy": True},
    "all but low-discrepancy": {"aggregate": True, "antithetic": True, "baseline": True},
    "all but aggregate": {"antithetic": True, "baseline": True, "low_discrepancy": True},
}
ORDERS = ("gradient", "hessian", "hvp")
MERGE = ("problems",)
QUICK = {"runs": 3, "samples": 32, "problem": ("quad",)}


def efficiency(
    problem: ur.Problem, sigma: float, order: str, options: dict[str, bool], runs: int, samples: int
) -> float:
    """Variance times evaluations. With `aggregate`, `samples` evaluations serve all elements; else they are divided among them."""
    parameters = problem.initial()
    evaluate = black_box(problem, parameters, 1, Key(0))
    theta = trees.ravel(parameters)
    counted = [0]

    def losses(points: np.ndarray) -> np.ndarray:
        counted[0] += len(points)
        return evaluate(points)

    elements = 1
    if not options["aggregate"]:
        elements = theta.size * (theta.size + 1) // 2 if order == "hessian" else theta.size
    share = max(samples // elements, 32 if order == "hvp" else 16)
    direction = np.random.default_rng(3).standard_normal(theta.size)
    rows = []
    for run in range(runs):
        own = {name: on for name, on in options.items() if order != "hvp" or name != "baseline"}
        points = (theta, direction) if order == "hvp" else (theta,)
        rows.append(np.ravel(getattr(ur.smoothed, order)(losses, *points, sigma, share, run, **own)[0]))
    return float(np.var(rows, axis=0, ddof=1).sum()) * counted[0] / runs


def run(problem: tuple[str, ...] = tuple(SIGMA), runs: int = 100, samples: int = 512) -> Iterator[dict[str, Any]]:
    """A part per problem.

    Args:
        samples: evaluations of an aggregate estimate
    """
    for name in problem:
        options = {} if name == "quad" else {"resolution": 24, "reference_spp": 256}
        made = ur.gallery.problem(name, **options)
        orders: dict[str, dict[str, float]] = {}
        for order in ORDERS:
            cuts = {
                cut: efficiency(made, SIGMA[name], order, {**PLAIN, **on}, runs, samples) for cut, on in CUTS.items()
            }
            orders[order] = {cut: value / cuts["plain"] for cut, value in cuts.items()}
            print(name, order, {cut: float(f"{v:.3g}") for cut, v in orders[order].items()}, flush=True)
        yield {"sigma": SIGMA, "problems": {name: orders}}


def table(record: Record) -> str:
    """Variance times evaluations over that of the plain estimator."""
    problems = record["problems"]
    names = list(next(iter(next(iter(problems.values())).values())))
    head = ["", *(f"{problem}: {order}" for problem, orders in problems.items() for order in orders)]
    rows = [
        [name, *(f"{cuts[name]:.2g}" for orders in problems.values() for cuts in orders.values())] for name in names
    ]
    text = "{runs} runs of {samples} evaluations; below 1 pays.".format(**record["settings"])
    return markdown.blocks(text, markdown.table(" | ".join(head), rows))
