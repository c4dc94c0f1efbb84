"""Stratified random numbers of paths."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unrender.core import arrays
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.mitsuba.samplers import StratifiedSampler
from unrender.rendering.renderer import SampleRequest

PIXELS = 512


@pytest.mark.parametrize("size", [1, 6, 64])
def test_each_pair_has_one_number_in_each_stratum_and_pairs_are_uncorrelated(size: int) -> None:
    """Of 64 numbers, one is in each interval of 1/64, and one pair in each square of an 8² grid."""
    sampler = StratifiedSampler(PIXELS * size, size)
    sampler.seed(mi.UInt32(3), 2 * PIXELS * size)
    pairs = np.array([np.array(sampler.next_2d()) for _ in range(4)]).reshape(8, 2, PIXELS, size).astype(np.float64)
    assert (pairs >= 0.0).all()
    assert (pairs < 1.0).all()
    np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])  # of the two copies
    numbers = pairs[:, 0]
    if size == 64:
        assert (np.sort(np.floor(numbers * 64), axis=-1) == np.arange(64)).all()
        cells = np.floor(numbers[0::2] * 8) * 8 + np.floor(numbers[1::2] * 8)
        assert (np.sort(cells, axis=-1) == np.arange(64)).all()
    flat = numbers.reshape(8, -1) - 0.5
    correlations = flat @ flat.T / flat.shape[1] * 12.0
    error = 1.0 / np.sqrt(flat.shape[1])
    assert np.abs(correlations - np.eye(8)).max() < 5.0 * error
    means = numbers.mean(axis=-1)  # of one pixel: independent of those of others and of other pairs
    assert np.abs(np.corrcoef(means[0::2]) - np.eye(4)).max() < 5.0 / np.sqrt(PIXELS)


@pytest.mark.parametrize("size", [2, 4])
def test_pairs_of_a_lane_are_independent(size: int) -> None:
    """Numbers of two pairs fill a grid of 8² cells evenly. Scrambles of consecutive pairs that are related leave up to a sixth too much."""
    sampler = StratifiedSampler(200_000 * size, size)
    sampler.seed(mi.UInt32(3), 200_000 * size)
    pairs = [np.array(sampler.next_2d()).reshape(2, -1, size)[..., 0] for _ in range(5)]  # one lane of each group
    cells = [np.floor(8 * x).astype(int) for x in pairs]
    for first, second in itertools.combinations(range(5), 2):
        for a, b in itertools.product(cells[first], cells[second]):
            counts = np.bincount(8 * a + b, minlength=64)
            excess = (np.square(counts - a.size / 64) / (a.size / 64)).sum() - 63.0
            assert excess < 6.0 * np.sqrt(2 * 63.0)


def test_stratified_images_are_unbiased_with_independent_groups_and_less_noise() -> None:
    """Lamp, sky and edges in the pixels: half of the variance at most. Groups of a pixel that shared strata would be anticorrelated."""
    scene = mi.cornell_box()
    scene["sensor"]["film"].update(width=16, height=16)
    renderer = MitsubaRenderer(scene)
    session = renderer.prepare([], None, derivatives=False)

    def images(stratified: bool, seed: int) -> np.ndarray:
        request = SampleRequest(0, 128, seed, groups=2, stratified=stratified)
        return arrays.numpy(session.image({}, request).images).astype(np.float64)

    plain, found = (np.array([images(kind, seed) for seed in range(24)]) for kind in (False, True))
    noise, less = (x.var(axis=(0, 1), ddof=1).mean() for x in (plain, found))
    assert less < 0.5 * noise
    error = np.sqrt((plain.var(axis=(0, 1), ddof=1) + found.var(axis=(0, 1), ddof=1)) / 48)
    z = (found.mean(axis=(0, 1)) - plain.mean(axis=(0, 1)))[..., 1] / np.maximum(error[..., 1], 1e-9)
    assert abs(np.mean(np.square(z)) - 1.0) < 0.4
    assert abs(z.mean()) < 5.0 / 16.0
    of_groups = found - found.mean(axis=0)
    correlation = (of_groups[:, 0] * of_groups[:, 1]).mean() / np.square(of_groups).mean()
    assert abs(correlation) < 5.0 / np.sqrt(24 * 256)
    dr.sync_thread()
