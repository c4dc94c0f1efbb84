"""The brute-force debiased gradient of the benchmarks (RCV Eq. 14), on a renderer whose exact gradient is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unrender as ur
from benchmarks.derivative_bias import DebiasedGradient, bias_correction
from tests.analytic import AnalyticRenderer
from tiers import quick
from unrender.core.random import Key

RUNS = 400
LIMIT = 4.5
"""Standard errors; both parameters together leave a chance of 1e-5."""


def problem(loss: Any) -> ur.Problem:
    """Eight pixels between 0.4 below and 0.4 above their reference, noise uniform in ±1 a sample: most signs are the noise's."""
    rng = np.random.default_rng(0)
    matrix = rng.uniform(0.2, 1.0, (24, 2))
    renderer = AnalyticRenderer({"x": np.array([0.5, 0.7])}, matrix, noise=0.0, grain=1.0, shape=(2, 4))
    image = renderer.exact({"x": np.array([0.5, 0.7])})
    reference = image + rng.uniform(-0.4, 0.4, image.shape) + 0.1
    return ur.Problem(renderer, [ur.Parameter("x", initial=0.5)], [ur.View(reference)], loss)


def z_scores(asked: ur.Problem, estimator: Any) -> np.ndarray:
    """Of the mean gradient over independent runs, against the gradient of the exact image."""
    at = asked.initial()
    renderer: Any = asked.renderer
    exact = asked.loss_derivative(0, renderer.exact(at)).reshape(-1) @ renderer.matrix
    state = estimator.init(asked, at)
    found = np.stack([estimator.estimate(asked, at, state, Key(run))[0].gradient["x"] for run in range(RUNS)])
    return (found.mean(0) - exact) / (found.std(0, ddof=1) / np.sqrt(RUNS))


@pytest.mark.parametrize("spp", quick([2, 4], 2))
def test_the_bias_is_gone_that_a_plain_gradient_has(spp: int) -> None:
    asked = problem(ur.losses.L1())
    assert np.abs(z_scores(asked, DebiasedGradient(spp, renders=2048))).max() < LIMIT
    assert np.abs(z_scores(asked, ur.PathGradient(spp=spp))).max() > 2 * LIMIT


def test_few_renders_leave_a_bias() -> None:
    assert np.abs(z_scores(problem(ur.losses.L1()), DebiasedGradient(2, renders=2))).max() > LIMIT


def test_a_linear_derivative_needs_none() -> None:
    asked = problem(ur.losses.L2())
    for seed in range(3):
        images = np.random.default_rng(seed).normal(size=(5, 2, 4, 3))
        correction = bias_correction(lambda x: asked.loss_derivative(0, x), images)
        np.testing.assert_allclose(correction, 0, atol=1e-12)


def test_the_correction_of_signs_in_closed_form() -> None:
    """sign(I) for I uniform in F ± 1 has the mean F; with ∂L(E[I]) = sign(F), the correction is sign(F) − F."""
    F, count = np.array([0.5, -0.3, 0.1]), 40_000
    images = F + np.random.default_rng(0).uniform(-1, 1, (count, 1, 1, 3))
    found = bias_correction(np.sign, images)[0, 0]
    error = np.sqrt((1 - F**2) / count)
    assert np.abs((found - (np.sign(F) - F)) / error).max() < LIMIT


def test_a_descent_on_its_gradients_stays_where_a_plain_one_drifts() -> None:
    """A quarter of the reference is far too bright: the median, which L1 finds, ignores it; signs of noise see the mean."""
    matrix = np.random.default_rng(0).uniform(0.5, 1.0, (24, 1))
    renderer = AnalyticRenderer({"x": np.array([1.0])}, matrix, noise=0.0, grain=1.0, shape=(2, 4))
    reference = renderer.exact({"x": np.array([1.0])})
    reference.reshape(-1)[:6] += 1.0
    asked = ur.Problem(renderer, [ur.Parameter("x", initial=1.0)], [ur.View(reference)], ur.losses.L1())

    def end(estimator: Any) -> float:
        runs = [ur.optimize(asked, estimator, ur.optimizers.Adam(0.01), steps=100, seed=seed) for seed in range(3)]
        return float(np.mean([run.last["x"] for run in runs]))

    assert end(DebiasedGradient(2, renders=1024)) == pytest.approx(1.0, abs=0.05)
    assert end(ur.PathGradient(spp=2)) > 1.2


def test_sizes_that_make_no_sense_are_refused() -> None:
    for spp, renders in ((1, 8), (17, 8), (2, 1)):
        with pytest.raises(ValueError, match="DebiasedGradient"):
            DebiasedGradient(spp, renders)
