"""Steady state of the control weights (RCV Fig. 3): weights and variance on a scene that does not change.

On an unchanging `indirect-room` the best weight is n/(n+1) and the variance 1/(n+1) of one render's. Five of the rules of
`benchmarks/weight_rules.py` weigh the same renders. With weight 0 until the statistics have a variance, the best that they
can reach is 1/(n-1). The variance is that over independent runs, per pixel, summed, divided by that of one render. The bias is the
mean over runs less that of the analytic rule on the same renders (which is unbiased), relative to the mean of the image.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.moments import Moments, summed_variances
from benchmarks.runner.records import Record
from benchmarks.weight_rules import one_run

RULES = ("analytic", "online", "absolute", "relative", "greater")
QUICK = {"resolution": 8, "spp": 2, "steps": 6, "runs": 3}


def run(resolution: int = 48, spp: int = 8, steps: int = 50, runs: int = 24) -> dict[str, Any]:
    """Weights, variance and bias of each rule over independent runs."""
    problem = ur.gallery.problem(
        "indirect-room", resolution=resolution, texture_resolution=resolution, reference_spp=16
    )
    single = Moments()
    images: dict[str, list[np.ndarray]] = {rule: [] for rule in RULES}
    weights: dict[str, Moments] = {rule: Moments() for rule in RULES}
    spread: dict[str, list[np.ndarray]] = {rule: [] for rule in RULES}
    for number in range(runs):
        kept, used = one_run(problem, [problem.initial()] * steps, spp, number, ("plain", *RULES))
        for F in kept["plain"]:
            single.add(F)
        for rule in RULES:
            images[rule].append(kept[rule].astype(np.float32))
            weights[rule].add(used[rule].mean(axis=(1, 2, 3)))
            spread[rule].append(np.percentile(used[rule], [10, 90], axis=(1, 2, 3)))
        print(f"run {number + 1} of {runs}", flush=True)
    unit, brightness = float(single.variance.sum()), float(single.mean.mean())
    rules = {}
    for rule in RULES:
        stack = np.stack(images[rule]).astype(np.float64)  # (runs, steps, H, W, 3)
        variance = summed_variances(stack) / unit
        extra = (stack[:, -1] - np.stack(images["analytic"])[:, -1]).mean(axis=(1, 2, 3)) / brightness
        rules[rule] = {
            "weight": weights[rule].mean.tolist(),
            "weight_10_90": np.mean(spread[rule], axis=0).tolist(),
            "variance": variance.mean(axis=0).tolist(),
            "variance_error": (variance.std(axis=0, ddof=1) / np.sqrt(runs)).tolist(),
            "bias": float(extra.mean()),
            "bias_error": float(extra.std(ddof=1) / np.sqrt(runs)),
        }
    return {"rules": rules}


def table(record: Record) -> str:
    text = "{resolution}², {spp} spp, {steps} steps, {runs} runs; at the last step but where it says otherwise, variance relative to one "
    text += "render's."
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.records(
            "rule | variance after 3 renders | weight | variance | bias",
            "{rule} | {variance[2]:.3f} | {weight[-1]:.3f} | {variance[-1]:.4f} | {bias:+.2%} ± {bias_error:.2%}",
            markdown.named(record["rules"], "rule"),
        ),
    )


def plot(record: Record) -> figures.Figure:
    """Weights and variance over the steps."""
    steps, rules = range(record["settings"]["steps"]), record["rules"]
    panels = {
        "weight": {rule: figures.over_steps(found["weight"]) for rule, found in rules.items()},
        "variance over one render's": {
            rule: figures.band(steps, found["variance"], found["variance_error"]) for rule, found in rules.items()
        },
    }
    return figures.curves(panels, "step", "")
