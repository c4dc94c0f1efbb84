"""What a judgement measures: closed forms, and what does not count."""

from __future__ import annotations

import math

import numpy as np
import pytest

from unrender.app.evaluation.measures import Measures, best_factors, compare_albedo, mean, measure
from unrender.core.errors import InputError
from unrender.losses import metrics

MASK = np.zeros((16, 20), np.float32)
MASK[3:12, 4:15] = 1


def photograph(level: float = 1.0) -> np.ndarray:
    return level * np.random.default_rng(0).uniform(0.1, 0.9, (16, 20, 3))


def test_equal_pictures_are_equal_whatever_lies_outside_the_mask() -> None:
    image = np.where(MASK[..., None] > 0, photograph(), 7.0)
    image[0, 0] = np.nan
    found = measure(image, photograph(), MASK)
    assert math.isinf(found.psnr)
    assert found.ssim == pytest.approx(1)
    assert mean([found])["ssim"] == found.ssim


def test_psnr_is_that_of_the_masks_pixels_as_photographed() -> None:
    image = photograph()
    image[5, 6] += 0.05
    wanted = np.mean((metrics.srgb(image) - metrics.srgb(photograph()))[MASK > 0] ** 2)
    found = measure(image, photograph(), MASK)
    assert found.psnr == pytest.approx(-10 * math.log10(wanted))
    assert found.exposure == 1
    assert found.ssim is not None
    assert found.ssim < 1


def test_photographs_above_one_are_exposed() -> None:
    """So that a factor of both changes nothing."""
    one, two = (measure(level * 1.1 * photograph(), photograph(level), MASK) for level in (3.0, 300.0))
    assert one.exposure == pytest.approx(100 * two.exposure)
    assert one.psnr == pytest.approx(two.psnr)
    assert one.exposure < 1


def test_a_mask_without_a_pixel_is_refused() -> None:
    with pytest.raises(InputError, match="a mask without a pixel"):
        measure(photograph(), photograph(), 0 * MASK)


def test_albedo_is_compared_up_to_a_factor_for_each_channel() -> None:
    truth = np.random.default_rng(1).uniform(0.2, 0.8, (500, 3))
    noise = np.random.default_rng(2).normal(size=truth.shape) * 0.01
    found = compare_albedo(truth / [0.5, 2.0, 1.25] + noise, truth)
    np.testing.assert_allclose(found.factors, [0.5, 2.0, 1.25], rtol=0.01)
    # Least squares leaves the noise, times the factors.
    assert found.scaled_rmse == pytest.approx(0.01 * math.sqrt((0.5**2 + 2.0**2 + 1.25**2) / 3), rel=0.1)
    assert found.rmse > 0.1


@pytest.mark.slow
def test_lpips_is_given_pictures_from_minus_one_to_one(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(metrics, "available", lambda: True)
    monkeypatch.setattr(
        metrics, "_network", lambda: lambda one, two: torch.mean(torch.abs(one[0, :, 0, 0] - two[0, :, 0, 0]))
    )
    picture = np.zeros((32, 40, 3))
    assert metrics.distance(picture + 0.75, picture) == pytest.approx(1.5)
    assert metrics.distance(picture[:31], picture[:31]) is None


def test_the_best_factors_are_those_of_least_squares() -> None:
    found = np.random.default_rng(3).uniform(0.1, 1, (40, 3)) * [1, 1, 0]
    truth = found * [0.5, 3.0, 1.0] + 0.01
    factors = best_factors(found, truth)
    assert factors[2] == 1  # of a black channel
    for step in (-1e-3, 1e-3):
        for channel in (0, 1):
            other = factors + step * np.eye(3)[channel]
            assert np.sum((found * other - truth) ** 2) > np.sum((found * factors - truth) ** 2)


def test_means_have_the_names_of_the_measures() -> None:
    """The record and the table of a judgement ask for them by these names."""
    known = Measures(psnr=20.0, ssim=0.5, lpips=0.25, exposure=1.0)
    unknown = Measures(psnr=30.0, ssim=None, lpips=None, exposure=1.0)
    assert mean([known]) == {"psnr": 20.0, "ssim": 0.5, "lpips": 0.25}
    assert mean([known, unknown]) == {"psnr": 25.0, "ssim": None, "lpips": None}
