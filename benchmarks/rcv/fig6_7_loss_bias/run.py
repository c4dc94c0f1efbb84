"""Bias of a loss and of its derivative from noisy images (RCV Figs 6 and 7).

Fig. 6: `indirect-room` with one unknown, a factor on the back wall's albedo, whose true value is 1. The mean over
noisy renders of the L1 and the L2 loss, and of their derivatives by the factor, at 1, 4, 16 and 64 spp: where the
loss is least, and where a descent would stop. The derivative is the mean of loss' (noisy image) · dI/dfactor, the two
from independent samples as in Eqs 12 and 13; dI/dfactor is a central difference of converged images on shared paths.
At factor 1.2, 4 spp, the mean of `unrender.PathGradient` (path replay) must agree.

Fig. 7: the derivative of the loss by each pixel at step 20 of a real descent, from a plain render and from a control
variate that took the same 20 steps; mean over runs less the derivative at a converged image, its mean square freed of
the runs' noise, and the variance. Derivatives are per pixel, times the number of pixels and channels, so that L1's
are ±1.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import Tree, arrays
from benchmarks.loss_landscape import LOSSES, check, places, sample, statistics
from benchmarks.moments import Moments, paired_bias
from benchmarks.paths import converged, descent, follow

KEY = "back.bsdf.reflectance.data"
TRUE_SCALE = 0.7
"""The true wall is this share of the photograph, so that factors up to 1.4 keep its albedo below 1."""
CHECK_FACTOR, CHECK_SPP = 1.2, 4
QUICK = {"resolution": 8, "runs": 3, "step": 3, "factors": 3, "reference_spp": 256}


def at(problem: ur.Problem, factor: float) -> Tree:
    """The parameters at a factor of the true wall."""
    return {KEY: problem.renderer.array(factor * TRUE_SCALE * problem.truth[KEY])}


def by_factor(problem: ur.Problem, factors: np.ndarray, runs: int, reference_spp: int) -> dict[str, Any]:
    """Loss and derivative at every factor, sample count and loss, with standard errors over runs."""

    def state(factor: float) -> Tree:
        return at(problem, factor)

    reference = converged(problem, state(1.0), reference_spp).mean
    values = sample(problem, state, factors.tolist(), runs, reference, reference_spp // 4)
    along = {KEY: TRUE_SCALE * problem.truth[KEY]}
    checked = check(problem, state(CHECK_FACTOR), along, reference, CHECK_SPP, 4 * runs)
    found = {"factors": factors.tolist(), "table": statistics(values), "places": places(factors.tolist(), values)}
    return {**found, "check": checked}


def derivatives(
    problem: ur.Problem, steps: int, spp: int, runs: int, reference_spp: int
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Fig. 7: numbers per loss and method, and maps."""
    path = descent(problem, ur.PathGradient(spp=16), 0.02, steps + 1)
    target = converged(problem, {KEY: problem.renderer.array(problem.truth[KEY])}, reference_spp).mean
    image = converged(problem, path[-1], reference_spp, seed=123_456).mean
    methods = {"plain": ur.images.Plain(), "rcv": ur.images.RecursiveControlVariate()}
    moments = {(loss, method): Moments() for loss in LOSSES for method in methods}
    variance = {method: Moments() for method in methods}
    maps: dict[str, np.ndarray] = {}
    for method, estimator in methods.items():
        taken = path if method == "rcv" else path[-1:]  # a plain render knows nothing of the steps before
        for run in range(runs):
            *_, last = follow(problem, estimator, taken, spp, run)
            noisy = arrays.numpy(last.mean()).astype(np.float64)
            variance[method].add(noisy)
            for name, loss in LOSSES.items():
                slope = loss.derivative(noisy, target)
                moments[name, method].add(slope - loss.derivative(image, target))
                if run == 0:
                    maps[f"{name}/{method}"] = slope.mean(axis=-1)
    result: dict[str, Any] = {}
    for name, loss in LOSSES.items():
        reference = loss.derivative(image, target)
        scale = float(np.abs(reference).mean())
        maps[f"{name}/reference"] = reference.mean(axis=-1)
        result[name] = {"scale": scale}
        for method in methods:
            found = moments[name, method]
            spread = float(found.variance.mean() / scale**2)
            result[name][method] = {**paired_bias(found, scale), "variance": spread}
            maps[f"{name}/{method}/bias"] = found.mean.mean(axis=-1)
    gain = float(variance["plain"].variance.sum() / variance["rcv"].variance.sum())
    return {"losses": result, "image_variance_ratio": gain}, maps


def run(
    resolution: int = 40, runs: int = 24, spp: int = 4, step: int = 20, factors: int = 13, reference_spp: int = 8192
) -> dict[str, Any]:
    """Both figures.

    Args:
        spp: of Fig. 7
        step: of Fig. 7
        factors: points between 0.6 and 1.4
    """
    problem = ur.gallery.problem("indirect-room", resolution=resolution, texture_resolution=resolution, loss="L1")
    fig6 = by_factor(problem, np.linspace(0.6, 1.4, factors), runs, reference_spp)
    fig7, maps = derivatives(problem, step, spp, runs, reference_spp)
    return {"fig6": fig6, "fig7": fig7, "maps": maps}
