"""Distributions of normals, and the parts in which they shrink and grow with roughness, against numerical integration."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, special, stats

from unrender.statistics.roughness import GGX, Beckmann, NormalDistribution

BOTH = pytest.mark.parametrize("distribution", [GGX(), Beckmann()], ids=["ggx", "beckmann"])
ALPHAS = pytest.mark.parametrize("alpha", [0.02, 0.1, 0.7])


def integral(distribution: NormalDistribution, alpha: float, function, low: float, high: float) -> float:
    """∫ function(t) D cosθ dω for t from `low` to `high`, over log t."""

    def integrand(x: float) -> float:
        t = np.exp(x)
        tangent = alpha * np.sqrt(t)
        angle = np.arctan(tangent)
        step = 0.5 * alpha * np.sqrt(t) / (1 + tangent**2)  # dθ / dx
        return function(t) * distribution.density(alpha, t) * np.cos(angle) * 2 * np.pi * np.sin(angle) * step

    found = integrate.quad(integrand, np.log(low), np.log(high), limit=400, epsabs=1e-10)
    return float(found[0])


@BOTH
@ALPHAS
def test_normals_have_a_density(distribution: NormalDistribution, alpha: float) -> None:
    assert integral(distribution, alpha, np.ones_like, 1e-12, 1e12) == pytest.approx(1, rel=1e-6)


@BOTH
@ALPHAS
def test_the_derivative_is_that_of_the_logarithm(distribution: NormalDistribution, alpha: float) -> None:
    """At a fixed normal: t changes with α."""
    step = 1e-5 * alpha
    for t in (0.01, 0.5, 1.0, 2.0, 9.0):
        fixed = t * alpha**2
        sides = [np.log(distribution.density(a, fixed / a**2)) for a in (alpha + step, alpha - step)]
        expected = (sides[0] - sides[1]) / (2 * step)
        assert distribution.log_derivative(alpha, t) == pytest.approx(expected, rel=1e-5, abs=1e-4 / alpha)


@BOTH
@ALPHAS
def test_both_parts_have_the_same_mass(distribution: NormalDistribution, alpha: float) -> None:
    def derivative(t: float) -> float:
        return distribution.log_derivative(alpha, t)

    inner, outer = (
        integral(distribution, alpha, derivative, 1e-12, 1),
        integral(distribution, alpha, derivative, 1, 1e12),
    )
    assert inner == pytest.approx(-distribution.mass(alpha), rel=1e-6)
    assert outer == pytest.approx(distribution.mass(alpha), rel=1e-6)


@BOTH
@ALPHAS
def test_equal_shares_of_the_parts_lie_between_one_and_the_sampled_slopes(
    distribution: NormalDistribution, alpha: float
) -> None:
    """The inverted distribution function against integrals of the density that `share` gives."""
    for u in (1e-3, 0.1, 0.5, 0.72, 0.73, 0.9, 0.999):
        inner, outer = distribution.parts(np.array(u))
        assert inner < 1 < outer
        assert integral(distribution, alpha, distribution.share, inner, 1) == pytest.approx(1 - u, abs=3e-5)
        assert integral(distribution, alpha, distribution.share, 1, outer) == pytest.approx(1 - u, abs=3e-5)
        # What forgets to invert, or confuses the parts, is seen.
        wrong = integral(distribution, alpha, distribution.share, inner**1.05, 1)
        assert wrong != pytest.approx(1 - u, abs=3e-5)


@BOTH
def test_sampled_slopes_have_the_density_of_their_part(distribution: NormalDistribution) -> None:
    """Kolmogorov and Smirnov's test in single precision, against the cumulative shares in closed form; a planted fault is seen."""
    u = 1 - np.random.default_rng(3).random(20_000, dtype=np.float32)
    inner, outer = distribution.parts(u)
    closed = {
        GGX: lambda t: 4 * t / (1 + t) ** 2,
        Beckmann: lambda t: t * np.exp(1 - t),
    }[type(distribution)]
    for t in (inner, outer):
        assert t.dtype == np.float32
        assert np.isfinite(t).all()
        assert stats.kstest(closed(t.astype(np.float64)), "uniform").pvalue > 1e-3
        wrong = np.where(t < 1, 1 - 1.1 * (1 - t), 1 + 1.1 * (t - 1)).clip(0)
        assert stats.kstest(closed(wrong.astype(np.float64)), "uniform").pvalue < 1e-3


def test_beckmanns_slopes_are_the_branches_of_lamberts_w() -> None:
    u = np.geomspace(1e-9, 1, 4001)[:-1]
    inner, outer = Beckmann().parts(u)
    np.testing.assert_allclose(inner, -special.lambertw(-u / np.e, 0).real, rtol=2e-5)
    np.testing.assert_allclose(outer, -special.lambertw(-u / np.e, -1).real, rtol=2e-5)
    for t in (inner, outer):
        np.testing.assert_allclose(t * np.exp(1 - t), u, rtol=2e-5)


def test_the_other_slope_of_a_ggx_pair_is_the_inverse() -> None:
    inner, outer = GGX().parts(np.linspace(0.01, 1, 50))
    np.testing.assert_allclose(inner * outer, 1)
