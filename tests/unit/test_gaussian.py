"""Kernels of Gaussian derivatives: their masses, samplers against densities by chi-square, mixtures against direct sums."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import integrate, stats

from unrender.statistics import gaussian

PHI = stats.norm.pdf


def test_masses_are_the_integrals() -> None:
    slope = integrate.quad(lambda z: abs(z) * PHI(z), -12, 12, points=[0])[0]
    curvature = integrate.quad(lambda z: abs(z * z - 1) * PHI(z), -12, 12, points=[-1, 1])[0]
    assert pytest.approx(slope, rel=1e-9) == gaussian.GRADIENT_MASS
    assert pytest.approx(curvature, rel=1e-9) == gaussian.CURVATURE_MASS


@pytest.mark.parametrize("z", [-3.0, -1.0, -0.2, 0.0, 0.7, 1.0, 2.5])
def test_the_distribution_integrates_the_density(z: float) -> None:
    found = integrate.quad(
        lambda t: float(gaussian.curvature_density(np.array(t))), -12, z, points=[-1] if z > -1 else None
    )[0]
    assert float(gaussian.curvature_distribution(np.array(z))) == pytest.approx(found, abs=1e-8)


def chi_square(samples: np.ndarray, density, bins: int = 60) -> float:
    """The p value of samples of a density on the line."""
    edges = np.concatenate([[-np.inf], np.linspace(-3.5, 3.5, bins - 1), [np.inf]])
    seen = np.histogram(samples, edges)[0]
    finite = np.clip(edges, -12, 12)
    mass = np.array(
        [integrate.quad(lambda t: float(density(np.array(t))), a, b)[0] for a, b in itertools.pairwise(finite)]
    )
    expected = mass / mass.sum() * len(samples)
    keep = expected > 5
    seen, expected = np.append(seen[keep], seen[~keep].sum()), np.append(expected[keep], expected[~keep].sum())
    seen, expected = seen[expected > 0], expected[expected > 0]
    return float(stats.chi2.sf(((seen - expected) ** 2 / expected).sum(), len(seen) - 1))


@pytest.mark.parametrize(
    ("sampler", "density"),
    [
        (gaussian.gradient_sample, gaussian.gradient_density),
        (gaussian.curvature_sample, gaussian.curvature_density),
    ],
)
def test_samplers_by_chi_square(sampler, density) -> None:
    u = np.random.default_rng(5).random(200_000)
    assert chi_square(sampler(u), density) > 1e-3
    assert chi_square(sampler(u) * 1.02, density) < 1e-3, "samples that are 2 % too wide went unseen"
    assert chi_square(gaussian.curvature_sample(u), gaussian.gradient_density) < 1e-3


@pytest.mark.parametrize("n", [1, 2, 5])
def test_mixture_densities_are_the_direct_sums(n: int) -> None:
    z = np.random.default_rng(n).normal(size=(20, n))
    one_slope, one_bend = gaussian.gradient_density(z) / PHI(z), gaussian.curvature_density(z) / PHI(z)
    np.testing.assert_allclose(gaussian.gradient_ratio(z), one_slope.mean(1))
    total = np.zeros(20)
    for i, j in itertools.product(range(n), range(n)):
        total += one_bend[:, i] if i == j else one_slope[:, i] * one_slope[:, j]
    np.testing.assert_allclose(gaussian.hessian_ratio(z), total / n**2)


@pytest.mark.parametrize("draw", ["gradient", "hessian"])
def test_mixture_samples_by_chi_square(draw: str) -> None:
    """In two dimensions, on a grid of cells, against the mixture's density."""
    rng = np.random.default_rng(8)
    count = 200_000
    sampler = gaussian.gradient_mixture if draw == "gradient" else gaussian.hessian_mixture
    ratio = gaussian.gradient_ratio if draw == "gradient" else gaussian.hessian_ratio
    z = sampler(rng.random(count), rng.random((count, 2)), rng.standard_normal((count, 2)))
    edges = np.linspace(-2.5, 2.5, 21)
    seen = np.histogram2d(z[:, 0], z[:, 1], (edges, edges))[0].ravel()
    fine = np.linspace(-2.5, 2.5, 20 * 16 + 1)
    middle = 0.5 * (fine[1:] + fine[:-1])
    grid = np.stack(np.meshgrid(middle, middle, indexing="ij"), -1).reshape(-1, 2)
    density = (ratio(grid) * PHI(grid).prod(1)).reshape(20, 16, 20, 16).sum((1, 3)).ravel() * (fine[1] - fine[0]) ** 2
    expected = density * count
    statistic = ((seen - expected) ** 2 / expected).sum() + (count - seen.sum() - (count - expected.sum())) ** 2 / (
        count - expected.sum()
    )
    assert stats.chi2.sf(statistic, len(seen)) > 1e-3


def test_kernels_are_derivatives_of_the_gaussian() -> None:
    sigma = np.array([0.5, 2.0, 1.3])
    tau = np.array([0.3, -1.0, 0.8])

    def density(t: np.ndarray) -> float:
        return float(np.prod(PHI(t / sigma) / sigma))

    step = 1e-4
    unit = np.eye(3) * step
    slope = [(density(tau + e) - density(tau - e)) / (2 * step) for e in unit]
    np.testing.assert_allclose(gaussian.gradient_kernel(tau[None] / sigma, sigma)[0] * density(tau), slope, rtol=1e-6)
    bend = [
        [
            (density(tau + a + b) - density(tau + a - b) - density(tau - a + b) + density(tau - a - b)) / (4 * step**2)
            for b in unit
        ]
        for a in unit
    ]
    np.testing.assert_allclose(
        gaussian.hessian_kernel(tau[None] / sigma, sigma)[0] * density(tau), bend, rtol=1e-4, atol=1e-7
    )
