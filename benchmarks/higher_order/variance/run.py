"""What each cut of the variance is worth: variance times evaluations of the gradient, the Hessian and its products
(Wang et al., section 3, and what their estimators leave on the table).

    python benchmarks/higher_order/variance/run.py [--runs 200] [--samples 512]

On `quad`, `box10` and `mug`, at the start. "plain": each element from its own kernel, nothing else. Then one cut at a time on top of it,
and all together. The figure is the variance summed over elements times the evaluations that all elements took together, over that
of "plain": below 1 it pays. Variance is over runs, of estimates at fixed random numbers of the renders.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, write

import unrender as ur
from unrender import smoothing as smoothed
from unrender.core import vectors
from unrender.core.random import Key
from unrender.estimators.loss_values import BlackBox

HERE = Path(__file__).resolve().parent
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


def efficiency(
    problem: ur.Problem, sigma: float, order: str, options: dict[str, bool], runs: int, samples: int
) -> float:
    """Variance times evaluations. With `aggregate`, `samples` evaluations serve all elements; else they are divided among them."""
    parameters = problem.initial()
    box = BlackBox(problem, parameters, 1, Key(0))
    theta = vectors.ravel(parameters)
    counted = [0]

    def losses(points: np.ndarray) -> np.ndarray:
        counted[0] += len(points)
        return box.losses(points)

    elements = 1
    if not options["aggregate"]:
        elements = theta.size * (theta.size + 1) // 2 if order == "hessian" else theta.size
    share = max(samples // elements, 32 if order == "hvp" else 16)
    direction = np.random.default_rng(3).standard_normal(theta.size)
    rows = []
    for run in range(runs):
        if order == "gradient":
            found, _ = smoothed.gradient(losses, theta, sigma, share, run, **options)
        elif order == "hessian":
            found, _ = smoothed.hessian(losses, theta, sigma, share, run, **options)
        else:
            own = {name: on for name, on in options.items() if name != "baseline"}
            found, _ = smoothed.hvp(losses, theta, direction, sigma, share, run, **own)
        rows.append(np.ravel(found))
    return float(np.var(rows, axis=0, ddof=1).sum()) * counted[0] / runs


def plot(results: dict[str, Any]) -> None:
    """Bars per problem and order."""
    problems = results["problems"]
    figure, axes = plt.subplots(1, len(problems), figsize=(4.6 * len(problems), 4), layout="constrained", sharey=True)
    for axis, (name, orders) in zip(axes, problems.items(), strict=True):
        for index, (order, cuts) in enumerate(orders.items()):
            values = [cuts[cut] for cut in CUTS if cut in cuts]
            axis.barh(np.arange(len(values)) + 0.27 * (index - 1), values, 0.25, label=order)
        axis.set_yticks(range(len(CUTS)), list(CUTS))
        axis.axvline(1.0, color="#888", lw=0.8)
        axis.set(title=name, xscale="log", xlabel="variance × evaluations over that of plain")
    axes[0].legend(fontsize=8)
    axes[0].invert_yaxis()
    figure.savefig(HERE / "figure.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--problem", action="append", choices=list(SIGMA))
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        problems: dict[str, Any] = {}
        for name in asked.problem or SIGMA:
            options = {} if name == "quad" else {"resolution": 24, "reference_spp": 256}
            problem = ur.gallery.problem(name, **options)
            problems[name] = {}
            for order in ORDERS:
                cuts = {
                    cut: efficiency(problem, SIGMA[name], order, {**PLAIN, **on}, asked.runs, asked.samples)
                    for cut, on in CUTS.items()
                }
                problems[name][order] = {cut: value / cuts["plain"] for cut, value in cuts.items()}
                print(name, order, {cut: float(f"{v:.3g}") for cut, v in problems[name][order].items()}, flush=True)
            write(HERE, {"runs": asked.runs, "samples": asked.samples, "sigma": SIGMA, "problems": problems})
    plot(read(HERE))


if __name__ == "__main__":
    main()
