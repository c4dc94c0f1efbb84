"""Where adaptive probabilities fail (Fig. 7 of the paper): a caustic, which paths from the camera find by chance.

    python benchmarks/adaptive/fig7_failure/run.py [--resolution 64] [--many 1024]

Probabilities estimated from 4 paths per pixel, as they come and denoised, and from many: the variance of the gradient at
the start, summed over parameters, when 512 pixels are drawn by them, two independent paths each, over that of uniform draws. Means over
estimates of the probabilities, of 256 gradients each. The same on two problems whose light is found easily. And how far maps from few
paths are from those of many: the correlation of their logarithms.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from common import read, write
from variance import gradients, spread

import unrender as ur
from unrender.core.random import Key
from unrender.estimators.path import PathGradient
from unrender.pixels.base import PixelSampler
from unrender.pixels.guided import MapDenoiser

HERE = Path(__file__).resolve().parent
PROBLEMS = ("caustic", "plain-and-textured", "mirror-trio")
FEW, COUNT, RUNS = 4, 512, 256


def maps(problem: ur.Problem, spp: int, seed: int) -> np.ndarray:
    """Probabilities over uniform ones, one per pixel of view 0."""
    height, width = problem.renderer.resolutions()[problem.views[0].sensor]
    scheme = ur.pixels.Adaptive(256, samples=spp * height * width * len(problem.views), denoiser="none", uniform=0.01)
    at = problem.initial()
    pick, _ = scheme.draw(problem, at, scheme.init(problem, at), Key(seed))
    return pick.probability[0]


def variances(problem: ur.Problem, many: int, repeats: int) -> dict[str, Any]:
    """By how the probabilities were found: the variance over that of uniform draws, mean and standard error."""
    height, width = problem.renderer.resolutions()[problem.views[0].sensor]
    pixels = height * width * len(problem.views)

    def summed(sampler: PixelSampler, seed: int) -> float:
        return spread(gradients(problem, PathGradient(pixels=sampler, spp=1), RUNS, seed)[0])[0]

    def adaptive(spp: int, denoiser: MapDenoiser) -> PixelSampler:
        return ur.pixels.Adaptive(COUNT, samples=spp * pixels, refresh=10 * RUNS, denoiser=denoiser, relative=False)

    uniform = float(np.mean([summed(ur.pixels.Uniform(COUNT), seed) for seed in range(repeats)]))
    found: dict[str, Any] = {}
    for name, sampler in (
        ("few", adaptive(FEW, "none")),
        ("few, denoised", adaptive(FEW, "auto")),
        ("many", adaptive(many, "none")),
    ):
        ratios = np.array([summed(sampler, seed) for seed in range(repeats)]) / uniform
        found[name] = {
            "mean": float(ratios.mean()),
            "error": float(ratios.std(ddof=1) / np.sqrt(repeats)),
            "worst": float(ratios.max()),
        }
    return found


def alike(a: np.ndarray, b: np.ndarray) -> float:
    """The correlation of two maps' logarithms."""
    return float(np.corrcoef(np.log(a).ravel(), np.log(b).ravel())[0, 1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--many", type=int, default=1024, help="paths per pixel of the map to compare with")
    parser.add_argument("--repeats", type=int, default=8)
    asked = parser.parse_args()
    ur.use()
    found: dict[str, Any] = {}
    cost: dict[str, Any] = {}
    kept: dict[str, np.ndarray] = {}
    for name in PROBLEMS:
        problem = ur.gallery.problem(name, resolution=asked.resolution)
        many = [maps(problem, asked.many, 100 + seed) for seed in range(2)]
        entry = {"many": alike(*many)}
        for spp in (2, 4, 16, 64):
            likeness = [alike(maps(problem, spp, seed), many[0]) for seed in range(asked.repeats)]
            entry[f"{spp}"] = float(np.mean(likeness))
        found[name] = entry
        cost[name] = variances(problem, asked.many, asked.repeats)
        print(name, entry, cost[name], flush=True)
        kept |= {
            f"{name}/reference": np.asarray(problem.views[0].reference),
            f"{name}/few": maps(problem, FEW, 0),
            f"{name}/many": many[0],
        }
    stored: dict[str, Any] = {key.replace("/", "|"): value for key, value in kept.items()}
    np.savez_compressed(HERE / "maps.npz", **stored)
    write(HERE, {"settings": vars(asked), "correlation": found, "variance": cost})
    plot(read(HERE))


def plot(results: dict[str, Any]) -> None:
    """Reference, map from few paths, map from many."""
    stored = np.load(HERE / "maps.npz")
    figure, axes = plt.subplots(len(PROBLEMS), 3, figsize=(9, 3.2 * len(PROBLEMS)), layout="constrained")
    for row, name in zip(axes, PROBLEMS, strict=True):
        row[0].imshow(np.clip(stored[f"{name}|reference"], 0, 1) ** (1 / 2.2))
        row[0].set_title(name)
        for axis, which in zip(row[1:], ("few", "many"), strict=True):
            axis.imshow(stored[f"{name}|{which}"], cmap="magma", norm="log")
            spp = FEW if which == "few" else results["settings"]["many"]
            ratio = results["variance"][name][which]["mean"]
            axis.set_title(f"{spp} paths a pixel: variance × {ratio:.2f}")
        for axis in row:
            axis.axis("off")
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


if __name__ == "__main__":
    main()
