"""A Hessian, and its diagonal, from curvatures along directions."""

from __future__ import annotations

import numpy as np
import pytest

from unrender.estimators.smoothed import (
    LEAST,
    corrected_diagonal,
    isotropic_fit,
    positive_diagonal,
    symmetric_update,
)

N = 40
TRUTH = np.random.default_rng(1).uniform(0.2, 2.0, N)


def rows_of(kind: str, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z, v = rng.standard_normal((count, N)), rng.standard_normal(N)
    return z * z if kind == "joint" else z * v


@pytest.mark.parametrize("kind", ["joint", "product"])
@pytest.mark.parametrize("count", [1, 8, 60])
def test_steps_of_exact_equations_find_the_diagonal(kind: str, count: int) -> None:
    found = np.full(N, isotropic_fit(rows := rows_of(kind, count, 0), rows @ TRUTH))
    for step in range(2400 // count):
        rows = rows_of(kind, count, step)
        found = corrected_diagonal(found, rows, rows @ TRUTH, 0.8)
    np.testing.assert_allclose(found, TRUTH, rtol=1e-3)


@pytest.mark.parametrize("kind", ["joint", "product"])
def test_a_step_is_the_least_change_that_fulfils_its_equations(kind: str) -> None:
    rows, start = rows_of(kind, 6, 3), np.ones(N)
    found = corrected_diagonal(start, rows, rows @ TRUTH, 1.0)
    before, after = rows @ (start - TRUTH), rows @ (found - TRUTH)
    assert np.linalg.norm(after) < 0.05 * np.linalg.norm(before)
    across = np.linalg.svd(rows)[2][6:]  # what the equations do not tell
    np.testing.assert_allclose(across @ (found - start), 0, atol=1e-12)
    half = corrected_diagonal(start, rows, rows @ TRUTH, 0.5)
    np.testing.assert_allclose(half - start, 0.5 * (found - start), rtol=1e-12)


def test_noise_is_averaged_by_a_small_rate() -> None:
    """Of equations with noise the error that stays falls with ω."""
    rng, errors = np.random.default_rng(0), {}
    for rate in (1.0, 0.1):
        found, late = np.ones(N), []
        for step in range(400):
            rows = rows_of("joint", 40, step)
            found = corrected_diagonal(found, rows, rows @ TRUTH + rng.standard_normal(40), rate)
            late += [found] if step >= 200 else []
        errors[rate] = np.sqrt(np.mean((np.array(late) - TRUTH) ** 2))
    assert errors[0.1] < 0.5 * errors[1.0]


def test_the_first_is_the_multiple_of_the_identity_that_fits_best() -> None:
    rows = rows_of("joint", 20, 5)
    assert isotropic_fit(rows, rows @ np.full(N, 1.7)) == pytest.approx(1.7)
    values = rows @ TRUTH
    best = isotropic_fit(rows, values)
    errors = [np.sum((c * rows.sum(axis=1) - values) ** 2) for c in (0.99 * best, best, 1.01 * best)]
    assert errors[1] == min(errors)


def test_nothing_is_told_by_rows_of_zeros() -> None:
    assert isotropic_fit(np.zeros((3, N)), np.ones(3)) == 0.0
    np.testing.assert_array_equal(corrected_diagonal(TRUTH, np.zeros((3, N)), np.ones(3), 1.0), TRUTH)


def test_what_is_used_is_positive() -> None:
    used = positive_diagonal(np.array([1.0, 3.0, -1.0, 0.0]))
    np.testing.assert_allclose(used, [1.0, 3.0, LEAST * 1.25, LEAST * 1.25])
    np.testing.assert_array_equal(positive_diagonal(TRUTH[TRUTH > 0.5]), TRUTH[TRUTH > 0.5])


def test_products_along_directions_determine_a_symmetric_matrix() -> None:
    rng = np.random.default_rng(4)
    half = rng.standard_normal((6, 6))
    truth, matrix = half + half.T, np.zeros((6, 6))
    for step in range(400):
        v = rng.standard_normal(6)
        v /= np.linalg.norm(v)
        matrix = symmetric_update(matrix, v, truth @ v, rate=1.0)
        if step == 0:
            np.testing.assert_allclose(matrix @ v, truth @ v, atol=1e-12)
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    np.testing.assert_allclose(matrix, truth, atol=1e-6)
    np.testing.assert_allclose(symmetric_update(matrix, v, np.zeros(6), rate=0.0), matrix)
