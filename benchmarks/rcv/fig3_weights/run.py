"""Steady state of the control weights (RCV Fig. 3): weights and variance on a scene that does not change.

On an unchanging `indirect-room` the best weight is n/(n+1) and the variance 1/(n+1) of one render's. Four rules weigh
the same renders:

- analytic: n/(n+1);
- online: Eq. 8 with Var[F_CV] from running statistics of F_CV itself, as if consecutive images were independent;
- relative: Eq. 8 with the recurrence (10), kept relative to Var[F]: `unrender.images.RecursiveControlVariate` itself;
- absolute: the same recurrence in absolute units, which keeps early, bad estimates of Var[F].

All but the analytic rule estimate variances from earlier renders, from step 1 on, so that the first weight above 0 is
that of step 3: the best that they can reach is 1/(n-1), a dotted line in the figure. The variance is that over
independent runs, per pixel, summed, divided by that of one render. The bias is the mean over runs less that of the
analytic rule on the same renders (which is unbiased), relative to the mean of the image.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Key, SampleRequest, advance, arrays, prepare
from benchmarks.moments import Moments, summed_variances
from benchmarks.paths import images_along
from unrender import statistics
from unrender.statistics import welford

RULES = ("analytic", "online", "absolute", "relative")
QUICK = {"resolution": 8, "spp": 2, "steps": 6, "runs": 3}


class Simulated:
    """A control variate on renders F = H of an unchanging scene, in NumPy, with one of the other rules."""

    def __init__(self, rule: str, first: np.ndarray):
        self.rule, self.step, self.image = rule, 0, first
        self.renders = welford.init(first)
        self.own = welford.update(welford.init(first), first, first)
        self.variance = np.zeros_like(first)

    def advance(self, F: np.ndarray) -> np.ndarray:
        """Takes the next render; returns the weight that it used."""
        self.step += 1
        var = welford.covariance(self.renders)
        if self.rule == "analytic":
            weight = np.full_like(F, self.step / (self.step + 1))
        else:
            var_cv = welford.covariance(self.own) if self.rule == "online" else self.variance
            weight = statistics.control_weight(var, var, var_cv)
        self.image = advance(self.image, F, F, weight)
        self.renders = welford.update(self.renders, F, F)
        self.own = welford.update(self.own, self.image, self.image)
        var = welford.covariance(self.renders)
        self.variance = statistics.control_variate_variance(weight, var, var, var, self.variance)
        return weight


def one_run(
    problem: ur.Problem, steps: int, spp: int, seed: int
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Renders (steps, H, W, 3), and per rule the images and the weights (0 at the first step) of the same shape."""
    start = problem.initial()
    session, sensor = prepare(problem, start, "path"), problem.views[0].sensor
    requests = [SampleRequest(sensor, spp, Key(seed, step).uint32()) for step in range(steps)]
    renders = np.stack([arrays.numpy(session.image(start, request).images[0]) for request in requests])
    renders = renders.astype(np.float64)
    images, weights = {}, {}
    for rule in ("analytic", "online", "absolute"):
        simulated = Simulated(rule, renders[0])
        used, kept = [np.zeros_like(renders[0])], [renders[0]]
        for F in renders[1:]:
            used.append(simulated.advance(F))
            kept.append(simulated.image)
        images[rule], weights[rule] = np.stack(kept), np.stack(used)
    relative = ur.images.RecursiveControlVariate()
    images["relative"], weights["relative"] = images_along(problem, relative, [start] * steps, spp, seed)
    return renders, images, weights


def run(resolution: int = 48, spp: int = 8, steps: int = 50, runs: int = 24) -> dict[str, Any]:
    """Weights, variance and bias of each rule over independent runs; the last weights of one run as maps."""
    problem = ur.gallery.problem(
        "indirect-room", resolution=resolution, texture_resolution=resolution, reference_spp=16
    )
    single = Moments()
    images: dict[str, list[np.ndarray]] = {rule: [] for rule in RULES}
    weights: dict[str, Moments] = {rule: Moments() for rule in RULES}
    spread: dict[str, list[np.ndarray]] = {rule: [] for rule in RULES}
    maps: dict[str, np.ndarray] = {}
    for number in range(runs):
        renders, kept, used = one_run(problem, steps, spp, number)
        for F in renders:
            single.add(F)
        for rule in RULES:
            images[rule].append(kept[rule].astype(np.float32))
            weights[rule].add(used[rule].mean(axis=(1, 2, 3)))
            spread[rule].append(np.percentile(used[rule], [10, 90], axis=(1, 2, 3)))
            maps.setdefault(rule, used[rule][-1].mean(axis=-1))
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
    return {"rules": rules, "maps": maps}
