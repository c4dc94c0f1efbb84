"""Measures of pictures: closed forms, and what is refused."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from unrender.core.errors import InputError
from unrender.losses import metrics

RNG = np.random.default_rng(5)
REFERENCE = RNG.uniform(0.05, 0.6, (32, 48, 3))


def similarity(image: np.ndarray, reference: np.ndarray) -> float:
    """SSIM, of pictures that are large enough for it."""
    found = metrics.ssim(image, reference)
    assert found is not None
    return found


def test_psnr_of_a_known_difference():
    """A flat difference is its own root mean square; over half of the picture, half the square."""
    reference = np.full((8, 8, 3), 0.5)
    factor = metrics.exposure(reference)
    assert factor == pytest.approx(1.4)
    shown, wanted = (metrics.srgb(x * factor) for x in (reference * 1.1, reference))
    assert metrics.psnr(reference * 1.1, reference) == pytest.approx(
        -20 * math.log10(float(shown.mean() - wanted.mean()))
    )
    half = reference.copy()
    half[:4] *= 1.1
    assert metrics.psnr(half, reference) == pytest.approx(metrics.psnr(reference * 1.1, reference) + 10 * math.log10(2))


def test_relative_mse_and_rmse_of_a_known_difference():
    reference = np.full((4, 5, 3), 0.3)
    assert metrics.relative_mse(reference + 0.1, reference) == pytest.approx(0.01 / (0.09 + 0.01))
    assert metrics.rmse(reference + 0.1, reference) == pytest.approx(0.1)
    assert metrics.relative_mse(np.zeros((2, 2, 3)), np.zeros((2, 2, 3))) == 0.0


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5])
def test_what_is_displayed_does_not_depend_on_the_unit_of_radiance(scale):
    image = REFERENCE * RNG.uniform(0.8, 1.2, REFERENCE.shape)
    for measure in (metrics.psnr, metrics.ssim):
        assert measure(image * scale, REFERENCE * scale) == pytest.approx(measure(image, REFERENCE), rel=1e-6)


def test_equal_pictures_are_the_best_there_are():
    assert metrics.psnr(REFERENCE, REFERENCE) == math.inf
    assert metrics.ssim(REFERENCE, REFERENCE) == pytest.approx(1.0)
    assert metrics.relative_mse(REFERENCE, REFERENCE) == 0.0
    assert metrics.rmse(REFERENCE, REFERENCE) == 0.0


def test_more_noise_is_worse_by_every_measure():
    little, much = (np.maximum(REFERENCE + RNG.normal(0, s, REFERENCE.shape), 0) for s in (0.01, 0.1))
    for measure, sign in ((metrics.psnr, 1), (similarity, 1), (metrics.relative_mse, -1), (metrics.rmse, -1)):
        assert sign * (measure(little, REFERENCE) - measure(much, REFERENCE)) > 0
    blurred = REFERENCE.mean((0, 1), keepdims=True) + 0 * REFERENCE
    assert similarity(blurred, REFERENCE) < 0.5  # no structure is left


def test_flip():
    pytest.importorskip("flip_evaluator", reason="needs flip-evaluator: pip install 'unrender[flip]'")
    assert metrics.flip(REFERENCE, REFERENCE) == 0.0
    little, much = (np.maximum(REFERENCE + RNG.normal(0, s, REFERENCE.shape), 0) for s in (0.01, 0.1))
    assert 0 < metrics.flip(little, REFERENCE) < metrics.flip(much, REFERENCE) < 1
    black, white = np.zeros((16, 16, 3)), np.ones((16, 16, 3))
    assert metrics.flip(black, white) > 0.8


def test_flip_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(InputError, match=r"pip install 'unrender\[flip\]'"):
        metrics.flip(REFERENCE, REFERENCE)


def test_small_pictures_take_smaller_windows_and_tiny_ones_none():
    small = REFERENCE[:4, :6]
    assert metrics.ssim(small, small) == pytest.approx(1.0)
    assert metrics.ssim(small[:2], small[:2]) is None


def test_pictures_that_diverged_are_as_bad_as_can_be():
    bad = REFERENCE.copy()
    bad[3, 4] = np.nan
    bad[5, 6] = np.inf
    assert metrics.relative_mse(bad, REFERENCE) == math.inf
    assert metrics.rmse(bad, REFERENCE) == math.inf
    assert math.isfinite(metrics.psnr(bad, REFERENCE))  # as displayed, NaN is black and infinity white


@pytest.mark.parametrize("shape", [(32, 48), (32, 48, 4), (31, 48, 3), (0, 48, 3)])
def test_other_shapes_are_refused(shape):
    for measure in (metrics.psnr, metrics.ssim, metrics.relative_mse, metrics.rmse):
        with pytest.raises(InputError, match="metrics: expected two pictures"):
            measure(np.zeros(shape), REFERENCE)
