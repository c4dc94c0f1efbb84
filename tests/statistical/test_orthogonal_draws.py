"""Orthogonal draws of smoothed derivatives: standard normals, orthogonal in blocks, unbiased, and what they gain."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.estimators.smoothing.sampling import SamplingOptions, SmoothedFunction

N = 6
RNG = np.random.default_rng(4)
MATRIX = RNG.normal(size=(N, N)) / N
MATRIX = MATRIX + MATRIX.T
SLOPE, THETA, SIGMA = RNG.normal(size=N) / np.sqrt(N), RNG.uniform(-0.5, 0.5, N), RNG.uniform(0.3, 0.6, N)
V = RNG.normal(size=N)
SPREAD = float(np.sum((SLOPE * SIGMA) ** 2))


def f(x: np.ndarray) -> np.ndarray:
    """½ xᵀ M x + (a·x)³."""
    return 0.5 * np.einsum("bi,ij,bj->b", x, MATRIX, x) + (x @ SLOPE) ** 3


GRADIENT = MATRIX @ THETA + 3 * SLOPE * ((THETA @ SLOPE) ** 2 + SPREAD)
HESSIAN = MATRIX + 6 * np.outer(SLOPE, SLOPE) * (THETA @ SLOPE)


def draws(samples: int, seed: int, n: int = N) -> np.ndarray:
    options = SamplingOptions(samples, seed, orthogonal=True)
    function = SmoothedFunction("gradient", f, np.zeros(n), 1.0, options)
    z, ratio = function.draw_aggregate(lambda *_: np.empty(0), lambda z: z)
    assert (ratio == 1.0).all()
    return z


def test_directions_are_orthogonal_in_blocks_and_independent_between_them() -> None:
    z = draws(2 * 15, 0)
    assert z.shape == (15, N)
    for first in (0, 6, 12):
        products = z[first : first + N] @ z[first : first + N].T
        np.testing.assert_allclose(products - np.diag(np.diagonal(products)), 0, atol=1e-12)
    assert abs(z[0] @ z[6]) > 1e-6


def test_each_draw_is_a_standard_normal() -> None:
    """Moments of one draw of a block over 3000 seeds, within 5 standard errors; lengths of exactly √n would be seen."""
    for which in (0, N - 1):
        rows = np.array([draws(2 * N, seed)[which] for seed in range(3000)])
        square = (rows * rows).sum(axis=1)
        found = np.concatenate([rows, rows**2 - 1, (rows**4 - 3), (rows[:, :-1] * rows[:, 1:])], axis=1)
        z = found.mean(axis=0) / (found.std(axis=0, ddof=1) / np.sqrt(len(found)))
        assert np.abs(z).max() < 5
        lengths = (square - N) ** 2 - 2 * N  # of χ² with n degrees of freedom
        error = lengths.std(ddof=1) / np.sqrt(len(lengths))
        assert abs(lengths.mean()) < 5 * error < 2 * N


def estimate(order: str, samples: int, seed: int, **options: Any) -> np.ndarray:
    if order.startswith("joint"):
        found = ur.smoothed.joint(f, THETA, SIGMA, samples, seed, **options)
        return {"joint gradient": found.gradient, "joint hessian": found.hessian}[order]()[0].ravel()
    if order == "hvp":
        return ur.smoothed.hvp(f, THETA, V, SIGMA, samples, seed, epsilon=0.01, **options)[0]
    return getattr(ur.smoothed, order)(f, THETA, SIGMA, samples, seed, **options)[0].ravel()


@pytest.mark.parametrize("samples", [8, 28], ids=["part of a block", "more than two blocks"])
@pytest.mark.parametrize(
    "order", quick(["gradient", "hessian", "hvp", "joint gradient", "joint hessian"], "joint hessian")
)
def test_derivatives_are_unbiased(order: str, samples: int) -> None:
    """Means over 1500 seeds, within 5 standard errors of the seeds' own spread; a planted bias is seen."""
    truth = {"gradient": GRADIENT, "hessian": HESSIAN.ravel(), "hvp": HESSIAN @ V}[order.split()[-1]]
    rows = np.array([estimate(order, samples, seed, orthogonal=True) for seed in range(1500)])
    error = rows.std(axis=0, ddof=1) / np.sqrt(len(rows))
    assert (np.abs(rows.mean(axis=0) - truth) < 5 * error).all()
    planted = 1.0 + 8 * float(np.min(error / np.abs(truth)))
    assert not (np.abs(planted * rows.mean(axis=0) - truth) < 5 * error).all()


def test_as_many_draws_as_dimensions_tell_a_linear_function() -> None:
    """What stays is the spread of their lengths, 2 / n of the square; independent draws leave all of it."""
    n = 64
    slope = np.random.default_rng(0).normal(size=n)

    def error(orthogonal: bool) -> float:
        found = [
            ur.smoothed.gradient(lambda x: x @ slope, np.zeros(n), 0.1, 2 * n, seed, orthogonal=orthogonal)[0]
            for seed in range(40)
        ]
        return float(np.mean(np.square(np.array(found) - slope)) / np.mean(slope**2))

    assert error(True) < 1.5 * 2 / n
    assert error(False) > 0.7


def test_orthogonal_draws_are_of_the_aggregate() -> None:
    for options in ({"low_discrepancy": True}, {"aggregate": False}, {"product": True}):
        with pytest.raises(ur.InputError, match="orthogonal requires aggregate"):
            ur.smoothed.gradient(f, THETA, SIGMA, 64, orthogonal=True, **options)
