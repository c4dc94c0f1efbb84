"""Bias of a loss and of its derivative from noisy images (RCV Figs 6 and 7).

Fig. 6: `indirect-room` with one unknown, a factor on the back wall's albedo, whose true value is 1. The mean over
noisy renders of the L1 and the L2 loss, and of their derivatives by the factor, at 1, 4, 16 and 64 spp: where the
loss is least, and where a descent would stop. The derivative is the mean of loss' (noisy image) · dI/dfactor, the two
from independent samples as in Eqs 12 and 13; dI/dfactor is a central difference of converged images on shared paths.
At factor 1.2, 4 spp, the mean of `unrender.PathGradient` (path replay) must agree.

Fig. 7: the derivative of the loss by each pixel at step 20 of a real descent, from a plain render and from a control
variate that took the same 20 steps; mean over runs less the derivative at a converged image, its mean square freed of
the runs' noise, and the variance. "debiased" is the plain render's with its bias subtracted, as 256 more renders tell it (Eq. 14): an
ablation, at 257 times the samples. Derivatives are per pixel, times the number of pixels and channels, so that L1's
are ±1.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import unrender as ur
from benchmarks.derivative_bias import derivatives
from benchmarks.internals import Tree
from benchmarks.loss_landscape import LOSSES, check, places, sample, statistics
from benchmarks.paths import converged, descent

KEY = "back.bsdf.reflectance.data"
TRUE_SCALE = 0.7
"""The true wall is this share of the photograph, so that factors up to 1.4 keep its albedo below 1."""
CHECK_FACTOR, CHECK_SPP = 1.2, 4
QUICK = {"resolution": 8, "runs": 3, "step": 3, "factors": 3, "renders": 4, "reference_spp": 256}


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


def run(
    resolution: int = 40,
    runs: int = 24,
    spp: int = 4,
    step: int = 20,
    factors: int = 13,
    renders: int = 256,
    reference_spp: int = 8192,
) -> dict[str, Any]:
    """Both figures.

    Args:
        spp: of Fig. 7
        step: of Fig. 7
        factors: points between 0.6 and 1.4
        renders: that tell the bias of Eq. 14
    """
    problem = ur.gallery.problem("indirect-room", resolution=resolution, texture_resolution=resolution, loss="L1")
    fig6 = by_factor(problem, np.linspace(0.6, 1.4, factors), runs, reference_spp)
    path = descent(problem, ur.PathGradient(spp=16), 0.02, step + 1)
    target = converged(problem, {KEY: problem.renderer.array(problem.truth[KEY])}, reference_spp).mean
    fig7, maps = derivatives(problem, path, LOSSES, target, spp, runs, renders, reference_spp)
    return {"fig6": fig6, "fig7": fig7, "maps": maps}
