"""Least squares from two halves against plain least squares, without the bias of squared noise."""

from __future__ import annotations

import numpy as np

from unrender.statistics.debiased import normal_equations


def test_the_normal_equations_are_those_of_weighted_least_squares() -> None:
    rng = np.random.default_rng(0)
    parts, weights = rng.normal(size=(2, 4, 5, 3)), rng.uniform(0.1, 1.0, (4, 5, 1))
    residual = rng.normal(size=(4, 5, 3))
    matrix, vector = normal_equations([parts, parts], [residual, residual], weights)
    roots = np.sqrt(np.broadcast_to(weights, residual.shape)).reshape(-1)
    expected = np.linalg.lstsq((parts.reshape(2, -1) * roots).T, residual.reshape(-1) * roots, rcond=None)[0]
    np.testing.assert_allclose(np.linalg.solve(matrix, vector), expected, rtol=1e-9)
    residual[0, 0, 1], parts[1, 2, 2, 0] = np.nan, np.inf
    without = weights.copy()
    without[0, 0] = without[2, 2] = 0.0
    again = normal_equations([parts, parts], [residual, residual], weights)
    finite = normal_equations([np.where(np.isfinite(parts), parts, 7.0)] * 2, [np.nan_to_num(residual)] * 2, without)
    for one, other in zip(again, finite, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_noise_does_not_bias_the_matrix() -> None:
    """One half squared would have 1 + 4 times the number of values."""
    rng = np.random.default_rng(1)
    noisy = [1.0 + 2.0 * rng.normal(size=(1, 200, 200, 3)) for _ in range(2)]
    matrix, _ = normal_equations(noisy, [np.zeros((200, 200, 3))] * 2, np.ones((1, 1, 1)))
    size = 200 * 200 * 3
    error = np.sqrt(size * (2.0 * 4.0 + 16.0))  # of a product of two values of variance 4 and mean 1
    assert abs(float(matrix[0, 0]) - size) < 4.0 * error < size
