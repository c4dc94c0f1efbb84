"""Covariance of sums of pixel scores, against the scatter of such sums over many draws of noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import convolve

from unrender.statistics import scores

SIDE, DRAWS = 16, 300
FILTER = np.array([[0.1, 0.5, 0.1], [0.5, 1.0, 0.5], [0.1, 0.5, 0.1]])
"""A film filter that neighbours share."""


def draws(filtered: bool) -> np.ndarray:
    """Return the scores of two smooth derivatives times noise, (DRAWS, 2, SIDE, SIDE)."""
    noise = np.random.default_rng(0).normal(size=(DRAWS, SIDE, SIDE))
    if filtered:
        noise = np.stack([convolve(one, FILTER, mode="wrap") for one in noise])
    slopes = np.stack([np.full((SIDE, SIDE), 1.0), np.linspace(0.5, 1.5, SIDE)[:, None] * np.ones(SIDE)])
    return noise[:, None] * slopes


@pytest.mark.parametrize("filtered", [False, True])
def test_neighbours_count_where_they_share_their_noise(filtered: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a filter, products with neighbours only have noise. The planted fault is the other choice."""
    values = draws(filtered)
    true = values.sum(axis=(2, 3)).var(axis=0)
    ratios = np.array([np.diag(scores.covariance(one, one)) for one in values]) / true
    error = np.sqrt(2.0 / DRAWS)  # of `true`
    assert np.mean(ratios) == pytest.approx(1.0, abs=(0.2 if filtered else 0.0) + 3.0 * error)
    monkeypatch.setattr(scores, "_neighbours_agree", lambda values: not filtered)
    planted = np.array([np.diag(scores.covariance(one, one)) for one in values]) / true
    if filtered:
        assert np.mean(planted) < 0.5
    else:
        assert np.std(planted) > 1.6 * np.std(ratios)


def test_a_pixel_that_a_fit_follows_counts_as_of_a_fit_without_it() -> None:
    """One pixel of five has most of the derivative. Residuals of the fit alone, the planted fault, tell a third of the variance."""
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(2, 40, 3))
    slopes[:, ::5] *= 6.0
    flat = slopes.reshape(2, -1)
    inverse = np.linalg.inv(flat @ flat.T)
    noise = rng.normal(size=(2000, 40, 1)) * np.ones(3)
    along = np.tensordot(noise, slopes, axes=([1, 2], [1, 2])) @ inverse
    residuals = noise - np.tensordot(along, slopes, axes=1)
    true = along.var(axis=0)

    def claimed(of: np.ndarray) -> np.ndarray:
        sums = np.einsum("kpc,npc->nkp", slopes, of)
        return np.mean([np.diag(inverse @ s @ s.T @ inverse) for s in sums], axis=0) / true

    assert (np.abs(claimed(scores.without_own_pixel(residuals, slopes, slopes, inverse)) - 1.15) < 0.25).all()
    assert (claimed(residuals) < 0.85).all()


@pytest.mark.parametrize("weighted", [False, True])
def test_leverages_have_no_bias_by_the_noise_of_the_slopes(weighted: bool) -> None:
    """Without the weights, or from one estimate of the slopes alone, the planted faults, residuals are divided by another 1 − h."""
    rng = np.random.default_rng(0)
    slopes, weights = rng.normal(size=(2, 40, 3)), rng.uniform(0.2, 2.0, (40, 1)) * np.ones(3) if weighted else None
    roots = 1.0 if weights is None else np.sqrt(weights)
    flat = (slopes * roots).reshape(2, -1)
    inverse = np.linalg.inv(flat @ flat.T)
    residuals, noise = rng.normal(size=(40, 3)), 0.5 * rng.normal(size=(400, 2, 2, 40, 3))
    exact = scores.without_own_pixel(residuals, slopes, slopes, inverse, weights)
    own = np.stack([np.einsum("kpc,kpd->pcd", np.tensordot(inverse, slopes * roots, axes=1), slopes * roots)])[0]
    expected = np.linalg.solve(np.eye(3) - own, (residuals / roots)[..., None])[..., 0] * roots
    np.testing.assert_allclose(exact, expected, rtol=1e-9)

    def off(shared: bool) -> float:
        sizes = []
        for a, b in noise:
            one, other = slopes + a, slopes + (a if shared else b)
            sizes.append(scores.without_own_pixel(residuals, one, other, inverse, weights) - exact)
        mean, error = np.mean(sizes, axis=0), np.std(sizes, axis=0) / np.sqrt(len(sizes))
        return float(np.mean(mean * np.sign(residuals)) / np.sqrt(np.mean(error**2)))

    assert abs(off(shared=False)) < 0.5 * off(shared=True)
    if weighted:
        plain = scores.without_own_pixel(residuals, slopes, slopes, inverse)
        assert np.abs(plain - exact).max() > 0.01


def test_small_and_negative_eigenvalues_are_left_out_of_the_inverse() -> None:
    rng = np.random.default_rng(0)
    units, turn = np.array([1.0, 1e3, 1e-3]), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    whole = turn @ np.diag([1.0, 0.5, 0.2]) @ turn.T * np.outer(units, units)
    np.testing.assert_allclose(scores.positive_inverse(whole) @ whole, np.eye(3), atol=1e-6)
    flat = np.array([[1.0, 1.0 + 1e-6], [1.0 + 1e-6, 1.0]])
    np.testing.assert_allclose(scores.positive_inverse(flat), np.full((2, 2), 0.25), rtol=1e-5)


def test_only_pixels_with_a_leverage_have_eigenvalues(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two pixels of many decide the fit. The others differ from the exact result by their leverage at most."""
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(2, 900, 3))
    slopes[:, :2] *= 200.0
    flat = slopes.reshape(2, -1)
    inverse, residuals = np.linalg.inv(flat @ flat.T), rng.normal(size=(900, 3))
    taken, eigh = [], np.linalg.eigh
    monkeypatch.setattr(np.linalg, "eigh", lambda of: taken.append(len(of)) or eigh(of))
    found = scores.without_own_pixel(residuals, slopes, slopes, inverse)
    monkeypatch.setattr(scores, "_LEAST_LEVERAGE", 0.0)
    exact = scores.without_own_pixel(residuals, slopes, slopes, inverse)
    assert taken == [2, 900]
    np.testing.assert_array_equal(found[2:], residuals[2:])
    np.testing.assert_allclose(found, exact, atol=2e-3 * np.linalg.norm(residuals, axis=1).max())
