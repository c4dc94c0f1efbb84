"""Gradient estimates and predicted deviations on a fixed path of parameters (Meta Figs 3 and 4).

On `indirect-room`, without an optimizer, so that nothing feeds back: the parameters go from the start to the truth in
equal steps (Fig. 3), or by steps that halve their distance (Fig. 4). Each method sees as many paths per step: the mean
that Adam keeps of plain gradients (decay 0.9) with the deviation that its two moments predict for it, the paper's
meta-estimate, and the coupled one. Three texels are shown: the one with the noisiest gradient, the 75th percentile, the
median.

The paper's own figures are of forward derivatives of pixels by one colour, here the left wall's blue while it and those of
floor and ceiling change, from one sample per pixel and step: `pixels.py` has them for all runs at once. Adam sees the
proportional samples alone. Beside the deviations it compares the variances that single runs estimate, and their α, with the
actual ones and the best α.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, Tree, arrays
from benchmarks.meta.fig3_4_estimates import pixels
from benchmarks.paths import geometric, straight

BETA_1, BETA_2 = 0.9, 0.999
METHODS = {
    "plain": ur.PathGradient(spp=4),
    "adam": ur.PathGradient(spp=4),
    "meta": ur.MetaEstimator(),
    "coupled": ur.MetaEstimator(coupled=True, spp=4),
}
HALF_LIFE = 8.0
TRUTH_SEED = 1_000_000
MERGE = ("sizes", "paths", "pixels")
QUICK = {
    "runs": 3, "steps": 6, "resolution": 8, "pixel_runs": 20, "pixel_steps": 30, "pixel_resolution": 4,
}  # fmt: skip


def estimates_along(
    problem: ur.Problem, method: str, path: list[Tree], seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(steps, n) each: the estimate, the deviation predicted for it, the weight of the past."""
    estimator = METHODS[method]
    state = estimator.init(problem, path[0])
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    first = second = np.zeros(1)

    def flat(tree: Tree) -> np.ndarray:
        return np.concatenate([arrays.numpy(x).ravel().astype(np.float64) for x in tree.values()])

    for step, parameters in enumerate(path):
        found, state = estimator.estimate(problem, parameters, state, Key(seed, step))
        gradient = flat(found.gradient if found.preconditioned else problem.coordinates.pull_back(found.gradient, {}))
        if found.variance is not None:
            rows.append((gradient, np.sqrt(flat(found.variance)), flat(found.info["alpha"])))
            continue
        first = BETA_1 * first + (1 - BETA_1) * gradient
        second = BETA_2 * second + (1 - BETA_2) * gradient**2
        count = step + 1
        mean, square = first / (1 - BETA_1**count), second / (1 - BETA_2**count)
        # Of a weighted mean of independent samples whose mean square is their variance.
        shrink = (1 - BETA_1) / (1 + BETA_1) * (1 + BETA_1**count) / (1 - BETA_1**count)
        if method == "adam":
            rows.append((mean, np.sqrt(square * shrink), np.full_like(gradient, BETA_1)))
        else:
            rows.append((gradient, np.sqrt(square), np.zeros_like(gradient)))
    a, b, c = (np.array([row[n] for row in rows]) for n in range(3))
    return a, b, c


def measure(problem: ur.Problem, path: list[Tree], runs: int) -> dict[str, Any]:
    """Per method: the actual deviation and error beside the predicted deviation, over all texels and for three of them."""
    taken = {method: [estimates_along(problem, method, path, seed) for seed in range(runs)] for method in METHODS}
    stacked = {m: [np.array([r[n] for r in rows]) for n in range(3)] for m, rows in taken.items()}
    others = np.array([estimates_along(problem, "plain", path, TRUTH_SEED + seed)[0] for seed in range(runs)])
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


def run(
    runs: int = 200,
    steps: int = 40,
    resolution: int = 24,
    part: tuple[str, ...] = ("texels", "pixels"),
    pixel_runs: int = 400,
    pixel_steps: int = 100,
    pixel_resolution: int = 12,
) -> Iterator[dict[str, Any]]:
    """Both paths, of texels' gradients and of pixels' derivatives.

    Args:
        part: measured; the other's figures stay
        pixel_runs: of the pixels' derivatives, rendered at once
        pixel_steps: of the pixels' derivatives
        pixel_resolution: of the pixels' derivatives
    """
    if "texels" in part:
        problem = ur.gallery.problem(
            "indirect-room", resolution=resolution, texture_resolution=8, loss="RelativeL2", reference_spp=1024
        )
        paths = {"linear": straight(problem, steps), "decaying": geometric(problem, steps, HALF_LIFE)}
        conditions = {"resolution": resolution, "steps": steps, "runs": runs}
        yield {"sizes": conditions, "paths": {name: measure(problem, path, runs) for name, path in paths.items()}}
    if "pixels" in part:
        derivatives = pixels.Derivatives(pixel_resolution, pixel_runs)
        found = {name: pixels.measure(derivatives, name, pixel_steps, HALF_LIFE) for name in ("linear", "decaying")}
        sizes = {"resolution": pixel_resolution, "steps": pixel_steps, "runs": pixel_runs}
        yield {"pixels": {**sizes, "paths": found}}
