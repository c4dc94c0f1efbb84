"""`PathGradient(tolerance=...)`: only where the loss is biased by noise, and the noise is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from backends import TEXTURE, problem

import unrender as ur
from unrender.core.random import Key
from unrender.losses.pixelwise import Loss


def gradients(loss: Loss, tolerance: float, spp: int = 4) -> list[np.ndarray]:
    """Of four steps at the same parameters."""
    asked = problem((TEXTURE,))
    asked = ur.Problem(asked.renderer, asked.parameters, asked.views, loss=loss, max_depth=3)
    estimator = ur.PathGradient(ur.images.RecursiveControlVariate(), spp=spp, tolerance=tolerance)
    start = asked.initial()
    state, found = estimator.init(asked, start), []
    for step in range(4):
        estimate, state = estimator.estimate(asked, start, state, Key(0, step))
        found.append(estimate.gradient[TEXTURE].numpy())
    return found


@pytest.mark.usefixtures("one_thread")
def test_of_a_loss_that_noise_biases_the_derivative_is_damped() -> None:
    plain, damped = (gradients(ur.losses.L1(), tolerance) for tolerance in (0.0, 1.0))
    for a, b in zip(plain, damped, strict=True):
        assert np.abs(b).sum() < 0.9 * np.abs(a).sum()
        assert (a * b).sum() > 0.5 * np.sqrt((a**2).sum() * (b**2).sum())


@pytest.mark.usefixtures("one_thread")
def test_of_a_single_sample_no_variance_is_known() -> None:
    plain, damped = (gradients(ur.losses.L1(), tolerance, spp=1) for tolerance in (0.0, 1.0))
    for step in (0, 1):
        np.testing.assert_array_equal(plain[step], damped[step])
    assert np.abs(damped[3]).sum() < 0.9 * np.abs(plain[3]).sum()


@pytest.mark.usefixtures("one_thread")
def test_of_an_unbiased_loss_nothing_is_changed() -> None:
    for a, b in zip(gradients(ur.losses.L2(), 0.0), gradients(ur.losses.L2(), 5.0), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_mini_batches_have_no_variance_and_no_damping() -> None:
    estimator = ur.PathGradient(ur.images.RecursiveControlVariate(), ur.pixels.Uniform(16), spp=2, tolerance=5.0)
    result = ur.optimize(problem((TEXTURE,)), estimator, ur.optimizers.Adam(0.02), steps=3)
    assert result.skipped == 0
    undamped = ur.optimize(problem((TEXTURE,)), replace(estimator, tolerance=0.0), ur.optimizers.Adam(0.02), steps=3)
    np.testing.assert_allclose(result.parameters[TEXTURE], undamped.parameters[TEXTURE], atol=1e-5)


def test_a_negative_tolerance_is_refused() -> None:
    with pytest.raises(ur.InputError, match=r"PathGradient: tolerance must be .*, got -1"):
        ur.PathGradient(tolerance=-1.0)
