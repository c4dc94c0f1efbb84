"""A control variate along a descent (Fig. 2 of the recursive control variates): `three-bodies`, L1.

    python benchmarks/volumes/fig2_weights/run.py [--steps 250] [--spp 4] [--runs 16] [--seeds 3] [--resolution 32]

Along the path of one descent with a control variate, seen again by independent runs: the weight that its pixels get, and its variance
over that of plain renders of as many samples, summed over pixels. Besides, each parameter's error over descents with a control variate and
with plain renders, Adam at one rate for both.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from along import descent, follow
from common import read, write
from rcv.fig3_weights.track import squares, track

import unrender as ur
from unrender.core import arrays

HERE = Path(__file__).resolve().parent
METHODS = {"rcv": ur.images.RecursiveControlVariate(), "plain": ur.images.Plain()}
COLOURS = {"rcv": "#1f6fb4", "plain": "#d1782a"}
QUANTILES = [10, 50, 90]


def descents(problem: ur.Problem, steps: int, spp: int, rate: float, seeds: int) -> tuple[dict[str, Any], list[Any]]:
    """{method: {parameter: (seeds, steps) of errors relative to the first}}, and the path of the first descent of "rcv"."""
    start, found, first = problem.parameter_error(problem.initial()), {}, []
    for method, image in METHODS.items():
        found[method] = {key: [] for key in start}
        for seed in range(seeds):
            path = descent(problem, ur.PathGradient(image, spp=spp), rate, steps, seed)
            first = first or path
            errors = [problem.parameter_error(state) for state in path]
            for key, begun in start.items():
                found[method][key].append([error[key] / begun for error in errors])
        print(method, {key: np.mean([run[-1] for run in runs]) for key, runs in found[method].items()}, flush=True)
    return found, first


def measure(problem: ur.Problem, path: list[Any], spp: int, runs: int) -> dict[str, Any]:
    """Weights and variance along the path, over independent runs."""
    images, means, quantiles = [], [], []
    for run in range(runs):
        kept, weights = track(problem, path, spp, 1000 + run)
        images.append(kept)
        means.append(weights.mean(axis=(1, 2, 3)))
        quantiles.append(np.percentile(weights, QUANTILES, axis=(1, 2, 3)))
    renders = []
    for run in range(runs):
        seen = follow(problem, ur.images.Plain(), path, spp, 5000 + run)
        renders.append(np.stack([arrays.numpy(estimate.mean()) for estimate in seen]).astype(np.float64))
    with_it, without = squares(np.stack(images)), squares(np.stack(renders))
    ratio = with_it.mean(axis=0) / without.mean(axis=0)
    spread = [x.std(axis=0, ddof=1) / np.sqrt(runs) / x.mean(axis=0) for x in (with_it, without)]
    return {
        "weight": np.mean(means, axis=0).tolist(),
        "weight_10_50_90": np.mean(quantiles, axis=0).tolist(),
        "variance_ratio": ratio.tolist(),
        "variance_ratio_error": (ratio * np.hypot(*spread)).tolist(),
    }


def plot(results: dict[str, Any]) -> None:
    """Weights, variance, and a panel for each parameter."""
    keys = list(results["errors"]["rcv"])
    figure = plt.figure(figsize=(12, 7), layout="constrained")
    grid = figure.add_gridspec(2, 6)
    axes = [figure.add_subplot(grid[0, 3 * n : 3 * n + 3]) for n in range(2)]
    axes += [figure.add_subplot(grid[1, 2 * n : 2 * n + 2]) for n in range(len(keys))]
    steps = np.arange(len(results["weight"]))
    low, median, high = np.array(results["weight_10_50_90"])
    axes[0].plot(steps, results["weight"], color=COLOURS["rcv"], label="mean")
    axes[0].plot(steps, median, color=COLOURS["rcv"], ls="--", label="median")
    axes[0].fill_between(steps, low, high, color=COLOURS["rcv"], alpha=0.15, lw=0, label="10th to 90th percentile")
    axes[0].set(title="control weight over pixels", xlabel="step", ylim=(0, 1.02))
    axes[0].legend(fontsize=8, loc="lower right")
    ratio, error = np.array(results["variance_ratio"]), np.array(results["variance_ratio_error"])
    axes[1].plot(steps, ratio, color=COLOURS["rcv"])
    axes[1].fill_between(steps, ratio - error, ratio + error, color=COLOURS["rcv"], alpha=0.2, lw=0)
    axes[1].axhline(1, color=COLOURS["plain"], lw=1)
    axes[1].set(title="variance / a plain render's", xlabel="step", yscale="log")
    for axis, key in zip(axes[2:], keys, strict=True):
        for method, colour in COLOURS.items():
            curves = np.array(results["errors"][method][key])
            axis.plot(steps, np.median(curves, axis=0), color=colour, label=method)
            axis.fill_between(steps, curves.min(axis=0), curves.max(axis=0), color=colour, alpha=0.15, lw=0)
        axis.set(title=f"error of {key.split('.')[0]}", xlabel="step", yscale="log")
        axis.legend(fontsize=8)
    settings = results["settings"]
    figure.suptitle(f"three-bodies, {settings['resolution']}², {settings['spp']} spp, L1, Adam at {settings['rate']:g}")
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--rate", type=float, default=0.01)
    parser.add_argument("--runs", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--resolution", type=int, default=32)
    parser.add_argument("--plot-only", action="store_true")
    asked = parser.parse_args()
    if not asked.plot_only:
        ur.use()
        problem = ur.gallery.problem("three-bodies", resolution=asked.resolution, reference_spp=4096)
        errors, path = descents(problem, asked.steps, asked.spp, asked.rate, asked.seeds)
        found = measure(problem, path, asked.spp, asked.runs)
        settings = {name: value for name, value in vars(asked).items() if name != "plot_only"}
        write(HERE, {"settings": settings, "errors": errors, **found})
    plot(read(HERE))


if __name__ == "__main__":
    main()
