"""Estimates and predicted deviations while parameters move on a fixed path (Balint et al. 2023, Figs 3 and 4).

    python benchmarks/meta/fig3_4_estimates/run.py [--runs 200] [--steps 40] [--resolution 24]

On `indirect-room`, without an optimizer, so that nothing feeds back: the parameters go from the start to the truth in equal steps
(Fig. 3), or by steps that halve their distance (Fig. 4). Each method sees as many paths per step: the mean that Adam keeps of plain
gradients (decay 0.9) with the deviation that its two moments predict for it, the paper's meta-estimate, and the coupled one. Three
texels are shown: the one with the noisiest gradient, the 75th percentile, the median.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from along import drift
from common import read, write

import unrender as ur
from unrender.core import arrays
from unrender.core.random import Key
from unrender.core.trees import Tree

HERE = Path(__file__).resolve().parent
BETA_1, BETA_2 = 0.9, 0.999
METHODS = {
    "plain": (ur.PathGradient(spp=4), "#bbbbbb"),
    "adam": (ur.PathGradient(spp=4), "#d1782a"),
    "meta": (ur.MetaEstimator(), "#1f6fb4"),
    "coupled": (ur.MetaEstimator(coupled=True, spp=4), "#1a8f4c"),
}
HALF_LIFE = 8.0
TRUTH_SEED = 1_000_000


def line(problem: ur.Problem, steps: int) -> list[Tree]:
    """From the start to the truth in equal steps."""
    start = problem.initial()
    truth = {key: problem.renderer.array(value) for key, value in problem.truth.items()}
    path = [
        {key: x + (truth[key] - x) * arrays.scalar(step / (steps - 1), x) for key, x in start.items()}
        for step in range(steps)
    ]
    arrays.evaluate(path)
    return path


def run(problem: ur.Problem, method: str, path: list[Tree], seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(steps, n) each: the estimate, the deviation predicted for it, the weight of the past."""
    estimator = METHODS[method][0]
    state = estimator.init(problem, path[0])
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    first = second = np.zeros(1)

    def flat(tree: Tree) -> np.ndarray:
        return np.concatenate([arrays.numpy(x).ravel().astype(np.float64) for x in tree.values()])

    for step, parameters in enumerate(path):
        found, state = estimator.estimate(problem, parameters, state, Key(seed, step))
        gradient = flat(found.gradient if found.preconditioned else problem.precondition(found.gradient))
        if found.variance is not None:
            rows.append((gradient, np.sqrt(flat(found.variance)), flat(found.info["alpha"])))
            continue
        first = BETA_1 * first + (1 - BETA_1) * gradient
        second = BETA_2 * second + (1 - BETA_2) * gradient**2
        made = step + 1
        mean, square = first / (1 - BETA_1**made), second / (1 - BETA_2**made)
        # Of a weighted mean of independent samples whose mean square is their variance.
        shrink = (1 - BETA_1) / (1 + BETA_1) * (1 + BETA_1**made) / (1 - BETA_1**made)
        adam = method == "adam"
        rows.append(
            (mean if adam else gradient, np.sqrt(square * (shrink if adam else 1)), 0 * gradient + BETA_1 * adam)
        )
    a, b, c = (np.array([row[n] for row in rows]) for n in range(3))
    return a, b, c


def measure(problem: ur.Problem, path: list[Tree], runs: int) -> dict[str, Any]:
    """Per method: the actual deviation and error beside the predicted deviation, over all texels and for three of them."""
    taken = {method: [run(problem, method, path, seed) for seed in range(runs)] for method in METHODS}
    stacked = {m: [np.array([r[n] for r in rows]) for n in range(3)] for m, rows in taken.items()}
    others = np.array([run(problem, "plain", path, TRUTH_SEED + seed)[0] for seed in range(runs)])
    truth = others.mean(0)
    of_truth = others.var(0, ddof=1) / runs  # per step and texel, what the noise of the truth adds to a squared error
    order = np.argsort(of_truth.mean(0))
    shown = [int(order[-1]), int(order[int(0.75 * len(order))]), int(order[len(order) // 2])]
    found: dict[str, Any] = {"texels": shown, "truth": truth[:, shown].tolist(), "methods": {}}
    for method, (estimate, predicted, alpha) in stacked.items():
        deviation = estimate.std(0, ddof=1)
        bias = estimate.mean(0) - truth
        known = np.sqrt(np.mean(predicted**2, 0))
        ratio = known[1:] / np.maximum(deviation[1:], 1e-30)
        # The mean over runs has noise of its own, so bias² counts deviation² / runs twice.
        error = deviation**2 * (1 - 1 / runs) + bias**2 - of_truth
        found["methods"][method] = {
            "run": estimate[0][:, shown].tolist(),
            "run_predicted": predicted[0][:, shown].tolist(),
            "deviation": deviation[:, shown].tolist(),
            "mean": estimate.mean(0)[:, shown].tolist(),
            "predicted": known[:, shown].tolist(),
            "alpha": alpha.mean((0, 2)).tolist(),
            "error": np.sqrt(np.maximum(np.mean(error, 1), 0)).tolist(),
            "predicted_over_actual": [float(q) for q in np.quantile(ratio, [0.05, 0.25, 0.5, 0.75, 0.95])],
        }
        print(f"{method}: last error {found['methods'][method]['error'][-1]:.3g}, predicted / actual "
              f"{[round(q, 2) for q in found['methods'][method]['predicted_over_actual']]}", flush=True)  # fmt: skip
    return found


def plot(results: dict[str, Any]) -> None:
    """Rows: the two paths. Columns: three texels, then the error over all texels, then predicted over actual deviation."""
    figure, axes = plt.subplots(2, 5, figsize=(20, 7.5), layout="constrained")
    for row, (name, found) in zip(axes, results["paths"].items(), strict=True):
        truth = np.array(found["truth"])
        steps = np.arange(len(truth))
        for column, axis in enumerate(row[:3]):
            for method in ("adam", "meta", "coupled"):
                entry, colour = found["methods"][method], METHODS[method][1]
                one, known = (np.array(entry[k])[:, column] for k in ("run", "run_predicted"))
                axis.plot(steps, one, color=colour, lw=1.2, label=method)
                axis.fill_between(steps, one - known, one + known, color=colour, alpha=0.15, lw=0)
                at = steps[5::10]
                axis.errorbar(at, np.array(entry["mean"])[at, column], np.array(entry["deviation"])[at, column],
                              fmt="none", ecolor=colour, capsize=2)  # fmt: skip
            axis.plot(steps, truth[:, column], "k--", lw=1, label="true")
            axis.plot(steps, np.array(found["methods"]["plain"]["run"])[:, column], ".", color="#999999", ms=2)
            axis.set(
                title=f"{name}: {('noisiest', '75th percentile', 'median')[column]} texel",
                xlabel="step",
                ylabel="gradient",
            )
            low, high = np.quantile(found["methods"]["plain"]["run"], [0.01, 0.99], axis=0)[:, column]
            axis.set_ylim(low, high)
        row[0].legend(fontsize=7)
        for method, (_, colour) in METHODS.items():
            entry = found["methods"][method]
            row[3].semilogy(entry["error"], color=colour, label=method)
            if method != "plain":
                q = entry["predicted_over_actual"]
                place = list(METHODS).index(method)
                row[4].plot([place, place], [q[0], q[4]], color=colour)
                row[4].plot([place, place], [q[1], q[3]], color=colour, lw=6, label=method)
                row[4].plot(place, q[2], "k_", ms=12)
        row[3].set(title="error, all texels", xlabel="step", ylabel="RMSE of the gradient")
        row[3].legend(fontsize=7)
        row[4].axhline(1, color="k", ls=":", lw=1)
        row[4].set(title="predicted / actual deviation", yscale="log", xticks=[])
        row[4].legend(fontsize=7)
    figure.savefig(HERE / "figure.png", dpi=90)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--resolution", type=int, default=24)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        problem = ur.gallery.problem(
            "indirect-room", resolution=asked.resolution, texture_resolution=8, loss="RelativeL2", reference_spp=1024
        )
        paths = {"linear": line(problem, asked.steps), "decaying": drift(problem, asked.steps, HALF_LIFE)}
        found = {name: measure(problem, path, asked.runs) for name, path in paths.items()}
        write(HERE, {"runs": asked.runs, "steps": asked.steps, "resolution": asked.resolution, "paths": found})
    plot(read(HERE))


if __name__ == "__main__":
    main()
