"""Variance of the gradient of one parameter, the roughness of a mirror, by how pixels are drawn (Fig. 3 of the paper).

    python benchmarks/adaptive/fig3_variance/run.py [--runs 1024] [--count 512] [--resolution 64]

`mirror-trio` at its start, L2. Every scheme traces as many paths a step: `count` pixels with two paths each; all pixels at once, at two
paths each, has its variance scaled to that budget. Of the two paths one gives the image and the other its derivative, as in the paper,
or, crossed, each gives both. The schemes that estimate probabilities do so
once, from `--samples` paths, before the runs; these are left out, as the paper leaves them. Draws independent of one another, as in the
paper, and stratified ones.
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
from schemes import SCHEMES, pixels
from variance import gradients, spread

import unrender as ur
from unrender.estimators.path import PathGradient

HERE = Path(__file__).resolve().parent
FIVE_LEVELS = "adaptive, five levels"
CROSSED = {1: "", 2: ", crossed"}
"""By the estimator's `spp`."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1024)
    parser.add_argument("--count", type=int, default=512)
    parser.add_argument("--samples", type=int, default=1 << 15)
    parser.add_argument("--resolution", type=int, default=64)
    asked = parser.parse_args()
    ur.use()
    problem = ur.gallery.problem("mirror-trio", resolution=asked.resolution)
    budget = 2 * asked.count
    found: dict[str, Any] = {}
    for spp, crossed in CROSSED.items():
        rows, samples, _ = gradients(problem, PathGradient(spp=spp), asked.runs)
        whole, error = spread(rows)
        found[f"all{crossed}"] = {"variance": whole * samples / budget, "error": error * samples / budget}
    exact = rows.mean(axis=0)
    maps = {}
    for spp, stratified in ((1, False), (2, False), (1, True), (2, True)):
        for label, levels in (*((scheme, {}) for scheme in SCHEMES), (FIVE_LEVELS, {"levels": 4})):
            scheme = "adaptive" if label == FIVE_LEVELS else label
            options: dict[str, Any] = {"stratified": stratified, "samples": asked.samples, "refresh": 10 * asked.runs}
            rows, samples, probability = gradients(
                problem, PathGradient(pixels=pixels(scheme, asked.count, **options, **levels), spp=spp), asked.runs
            )
            assert samples == budget
            variance, error = spread(rows)
            name = label + CROSSED[spp] + (", stratified" if stratified else "")
            z = (rows.mean(axis=0) - exact) / np.sqrt(np.var(rows, axis=0, ddof=1) / asked.runs)
            found[name] = {"variance": variance, "error": error, "z": float(np.abs(z).max())}
            if probability:
                maps[name] = probability[0]
            print(name, found[name], flush=True)
    ratios = {
        f"{other}{end} / {ours}{end}": found[other + end]["variance"] / found[ours + end]["variance"]
        for end in ("", ", crossed", ", stratified", ", crossed, stratified")
        for ours in ("adaptive", FIVE_LEVELS)
        for other in ("uniform", "loss")
    }
    for crossed in CROSSED.values():
        ratios[f"all{crossed} / adaptive{crossed}"] = (
            found[f"all{crossed}"]["variance"] / found[f"adaptive{crossed}"]["variance"]
        )
    print(ratios)
    np.savez_compressed(HERE / "maps.npz", reference=np.asarray(problem.views[0].reference), **maps)
    write(HERE, {"settings": vars(asked), "schemes": found, "ratios": ratios})
    plot(read(HERE))


def plot(results: dict[str, Any]) -> None:
    """The picture, where the schemes look, and what it brings."""
    maps = np.load(HERE / "maps.npz")
    figure, axes = plt.subplots(1, 4, figsize=(16, 4), layout="constrained", width_ratios=(1, 1.15, 1.15, 1.3))
    axes[0].imshow(np.clip(maps["reference"], 0, 1) ** (1 / 2.2))
    axes[0].set_title("reference")
    for axis, name in zip(axes[1:3], ("loss", "adaptive"), strict=True):
        shown = axis.imshow(maps[name], cmap="magma", norm="log", vmin=0.1)
        axis.set_title(f"{name}, over uniform")
        figure.colorbar(shown, ax=axis)
    for axis in axes[:3]:
        axis.axis("off")
    entries = results["schemes"]
    axes[3].barh(list(entries), [e["variance"] for e in entries.values()], xerr=[e["error"] for e in entries.values()])
    axes[3].set(xscale="log", xlabel="variance of dL/d(roughness)")
    figure.savefig(HERE / "figure.png", dpi=110)
    print(f"wrote {HERE / 'figure.png'}")


if __name__ == "__main__":
    main()
