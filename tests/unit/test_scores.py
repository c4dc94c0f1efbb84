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

    assert (np.abs(claimed(scores.without_own_pixel(residuals, slopes, inverse)) - 1.15) < 0.25).all()
    assert (claimed(residuals) < 0.85).all()
