"""Variance of one parameter's gradient by pixel sampler (Adaptive Fig. 3): the roughness of a mirror.

`mirror-trio` at its start, L2. Every scheme traces as many paths a step: `count` pixels with two paths each; all pixels
at once, at two paths each, has its variance scaled to that budget. Of the two paths one gives the image and the other
its derivative, as in the paper, or, in leave-one-out sample groups, each gives both. The schemes that estimate
probabilities do so once, from `samples` paths, before the runs; these are left out, as the paper leaves them. Samples
independent of one another, as in the paper, and stratified ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks.gradient_variance import gradients, spread
from benchmarks.pixel_schemes import SCHEMES, pixels

FIVE_LEVELS = "adaptive, five levels"
GROUPS = {1: "", 2: ", leave-one-out"}
"""By the estimator's `spp`."""
QUICK = {"runs": 8, "count": 16, "samples": 1 << 10, "resolution": 16}


def ratios(variance: dict[str, float]) -> dict[str, float]:
    """Of the schemes to adaptive sampling."""
    found = {
        f"{other}{end} / {ours}{end}": variance[other + end] / variance[ours + end]
        for end in (group + order for order in ("", ", stratified") for group in GROUPS.values())
        for ours in ("adaptive", FIVE_LEVELS)
        for other in ("uniform", "loss")
    }
    return found | {
        f"all{end} / adaptive{end}": variance[f"all{end}"] / variance[f"adaptive{end}"] for end in GROUPS.values()
    }


def run(runs: int = 1024, count: int = 512, samples: int = 1 << 15, resolution: int = 64) -> dict[str, Any]:
    """Variances, their ratios, and probabilities as maps.

    Args:
        count: pixels a step
        samples: paths that probabilities are estimated from
    """
    problem = ur.gallery.problem("mirror-trio", resolution=resolution)
    budget, found = 2 * count, {}
    maps = {"reference": np.asarray(problem.views[0].reference)}
    exact: Any = None
    for spp, group in GROUPS.items():
        rows, paths, _ = gradients(problem, ur.PathGradient(spp=spp), runs)
        variance, error = spread(rows)
        found[f"all{group}"] = {"variance": variance * paths / budget, "error": error * paths / budget}
        exact = rows.mean(axis=0)
    for spp, stratified in ((1, False), (2, False), (1, True), (2, True)):
        for label, levels in (*((scheme, {}) for scheme in SCHEMES), (FIVE_LEVELS, {"levels": 4})):
            scheme = "adaptive" if label == FIVE_LEVELS else label
            fixed = {"uniform": 0.1, "learn_from_draws": False, "by_cost": False}
            options: dict[str, Any] = {"stratified": stratified, "samples": samples, "refresh": 10 * runs, **fixed}
            sampler = pixels(scheme, count, **options, **levels)
            rows, paths, probability = gradients(problem, ur.PathGradient(pixels=sampler, spp=spp), runs)
            if paths != budget:
                raise RuntimeError(f"{label} traced {paths} paths, not {budget}")
            variance, error = spread(rows)
            name = label + GROUPS[spp] + (", stratified" if stratified else "")
            z = (rows.mean(axis=0) - exact) / np.sqrt(np.var(rows, axis=0, ddof=1) / runs)
            found[name] = {"variance": variance, "error": error, "z": float(np.abs(z).max())}
            if probability:
                maps[name] = probability[0]
            print(name, found[name], flush=True)
    return {"schemes": found, "ratios": ratios({n: e["variance"] for n, e in found.items()}), "maps": maps}
