"""Damped loss derivatives: Charbonnier's loss in closed form, and noise of skewed distribution that no longer pulls."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from unrender.estimators.gradient_sum import damping, smoothed_variance
from unrender.estimators.sample_groups import _derivative
from unrender.images.base import variance_of_mean
from unrender.losses import L1
from unrender.scene.batches import PixelBatch, PixelSample


def test_the_damped_sign_is_the_derivative_of_charbonniers_loss():
    residual, variance = np.array([[[-2.0, 0.3, 1.0]]]), np.array([[[0.25, 4.0, 1e-8]]])
    step = 1e-5

    def loss(r: np.ndarray) -> np.ndarray:
        return np.sqrt(r * r + 9.0 * variance)

    expected = (loss(residual + step) - loss(residual - step)) / (2 * step)
    found = L1().derivative(residual, np.zeros_like(residual)) * damping(residual, variance, 3.0)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    np.testing.assert_allclose(damping(residual, variance * 0.0, 3.0), 1.0, rtol=1e-9)
    assert np.isfinite(damping(np.zeros((1, 1, 3)), np.zeros((1, 1, 3)), 2.0)).all()


def test_fireflies_do_not_pull_a_pixel_that_is_right():
    """Noise of mean 0 that is below 0 in 19 of 20 samples: its sign pulls with 0.9, the damped derivative with a fifth of that."""
    chosen = np.random.default_rng(0).random((400, 400, 3)) < 0.05
    noise = np.where(chosen, 19.0, -1.0)
    pull = np.sign(noise) * damping(noise, np.full(noise.shape, noise.var()), 2.0)
    standard_error = pull.std() / np.sqrt(pull.size)
    assert np.sign(noise).mean() == pytest.approx(-0.9, abs=0.01)
    assert abs(pull.mean()) < 0.18 * abs(np.sign(noise).mean()) - 4 * standard_error


def test_variances_are_averaged_over_neighbours():
    spike = np.zeros((41, 41, 3), np.float32)
    spike[20, 20] = 81.0**2
    found = smoothed_variance(spike)
    assert found[20, 20, 0] == pytest.approx(81.0, rel=1e-4)
    assert found[20, 28, 0] == pytest.approx(9.0, rel=1e-4)
    assert found[20, 29, 0] == pytest.approx(0.0, abs=1e-3)
    assert found.sum() == pytest.approx(spike.sum(), rel=1e-4)
    np.testing.assert_allclose(smoothed_variance(np.full((5, 3, 3), 2.0)), 2.0, rtol=1e-6)


def test_the_variance_of_a_mean_is_that_of_numpy():
    images = np.random.default_rng(0).normal(3.0, 1.0, (7, 5, 4, 3))
    found = variance_of_mean(images)
    assert found is not None
    np.testing.assert_allclose(found, images.var(axis=0, ddof=1) / 7, rtol=1e-9)
    assert variance_of_mean(images[:1]) is None


def test_mini_batches_of_whole_views_are_damped_as_these_are() -> None:
    """By the variance around each pixel in its own view; what fills a batch up, and pixels drawn here and there, are not."""
    random, sizes = np.random.default_rng(0), [(3, 4), (5, 2)]
    views, pixels = np.r_[np.zeros(12, int), np.ones(10, int), 0], np.r_[np.arange(12), np.arange(10), 0]
    reference, image, variance = random.random((3, 23, 3))
    targets = SimpleNamespace(at=lambda views, pixels: (reference, np.ones((len(views), 1))))
    problem: Any = SimpleNamespace(sizes=sizes, loss=L1(), references=targets)
    frame = PixelBatch(problem, PixelSample(views, pixels, np.ones((23, 1))))
    assert frame.complete_views == ((slice(0, 12), (3, 4)), (slice(12, 22), (5, 2)))
    around = [smoothed_variance(variance[rows].reshape(*size, 3)).reshape(-1, 3) for rows, size in frame.complete_views]
    expected = damping(image - reference, np.concatenate([*around, np.zeros((1, 3))]), 2.0)
    np.testing.assert_allclose(_derivative(problem, frame, variance, 2.0)(image), np.sign(image - reference) * expected)
    order = random.permutation(23)
    drawn = PixelBatch(problem, PixelSample(views[order], pixels[order], np.ones((23, 1))))
    np.testing.assert_array_equal(_derivative(problem, drawn, variance, 2.0)(image), np.sign(image - reference))
