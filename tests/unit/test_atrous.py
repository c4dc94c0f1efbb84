"""The shrinkage of an à-trous decomposition: closed forms, and its risk against that of the unbiased map."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from unrender.estimators import filtered

OPEN = (False, False)
RNG = np.random.default_rng
N = 32


def noise(seed: int, channels: int = 3) -> np.ndarray:
    return RNG(seed).normal(size=(N, N, channels))


def smooth_truth() -> np.ndarray:
    y, x = np.mgrid[:N, :N] / N
    return np.stack([np.sin(6 * x) + y, np.cos(3 * y), x * y], -1)


BOARD = np.repeat(np.indices((N, N)).sum(0)[..., None] % 2 * 2.0 - 1.0, 3, -1)


@pytest.mark.parametrize("grid", [(9, 14), (1, 7), (5, 6, 7)])
@pytest.mark.parametrize("wraps", [False, True])
def test_details_and_what_is_left_sum_up(grid: tuple[int, ...], wraps: bool) -> None:
    x, guide = RNG(1).normal(size=(*grid, 2)), RNG(2).normal(size=(*grid, 3))
    parts = list(filtered.details(x, guide, (wraps,) * len(grid)))
    assert [spacing for spacing, _, _ in parts] == [1 << level for level in range(filtered.levels_of(grid))]
    np.testing.assert_allclose(sum(detail for _, detail, _ in parts) + parts[-1][2], x, atol=1e-12)
    for _, detail, left in filtered.details(np.full_like(x, 2.0), guide, (wraps,) * len(grid)):
        np.testing.assert_allclose(detail, 0.0, atol=1e-12)
        np.testing.assert_allclose(left, 2.0)


def test_without_a_guide_a_smoothing_is_the_mean_by_the_taps() -> None:
    x = np.zeros((7, 7, 1))
    x[3, 3] = 16.0
    _, detail, left = next(filtered.details(x, np.zeros_like(x), OPEN))
    np.testing.assert_allclose(left[2:5, 2:5, 0], [[1, 2, 1], [2, 4, 2], [1, 2, 1]])
    np.testing.assert_allclose(detail, x - left)


def test_without_noise_nothing_changes() -> None:
    x = noise(0)
    found, kept = filtered.shrunk(x, np.zeros_like(x), noise(1), OPEN)
    np.testing.assert_allclose(found, x, atol=1e-12)
    assert kept == pytest.approx([1.0] * len(kept))


def test_where_noise_is_all_of_it_the_share_is_james_and_steins() -> None:
    """With a sample of the noise equal to the map, S² e² / S² d² is 1 everywhere: 1 − (p − 2) / (p + 2) of each detail is kept."""
    x = noise(0)
    numbers = 3 * (128 / 35) ** 2
    share = 4 / (numbers + 2)
    found, kept = filtered.shrunk(x, x, np.zeros_like(x), OPEN)
    left = list(filtered.details(x, np.zeros_like(x), OPEN))[-1][2]
    np.testing.assert_allclose(found, left + share * (x - left), atol=1e-12)
    assert kept == pytest.approx([share] * len(kept))


def test_pooled_numbers_are_those_of_a_mean_by_the_taps_twice() -> None:
    taps = np.convolve([0.25, 0.5, 0.25], [0.25, 0.5, 0.25])
    assert pytest.approx(1 / np.sum(taps**2)) == 128 / 35


def test_halves_noisier_than_they_are_leave_nothing() -> None:
    x = noise(0)
    found, kept = filtered.shrunk(x, 3 * x, np.zeros_like(x), OPEN)
    assert kept == [0.0] * len(kept)
    np.testing.assert_allclose(found, list(filtered.details(x, np.zeros_like(x), OPEN))[-1][2], atol=1e-12)


def ratios(truth: np.ndarray, size: float, told: float = 1.0, count: int = 24) -> np.ndarray:
    """(count,): squared errors of the shrunk map over those of the unbiased one; `told` falsifies the noise's size."""
    found = []
    for seed in range(count):
        x = truth + size * noise(2 * seed)
        shrunk, _ = filtered.shrunk(x, told * size * noise(2 * seed + 1), np.zeros_like(x), OPEN)
        found.append(np.square(shrunk - truth).sum() / np.square(x - truth).sum())
    return np.array(found)


@pytest.mark.parametrize(
    ("truth", "most"),
    [(np.zeros((N, N, 3)), 0.1), (smooth_truth(), 0.15), (BOARD, 0.6)],
    ids=["nothing", "smooth", "checkerboard"],
)
def test_the_risk_is_below_that_of_the_unbiased_map(truth: np.ndarray, most: float) -> None:
    """At the map's own size of noise, by more than four standard errors; and not if the noise is told to be a fifth of what it is."""
    found, planted = ratios(truth, 1.0), ratios(truth, 1.0, told=0.2)
    error = found.std(ddof=1) / np.sqrt(len(found))
    assert found.mean() + 4 * error < most
    assert planted.mean() - 4 * planted.std(ddof=1) / np.sqrt(len(planted)) > most, "noise told too small went unseen"


@pytest.mark.parametrize("truth", [smooth_truth(), BOARD], ids=["smooth", "checkerboard"])
def test_it_approaches_the_unbiased_map_as_noise_falls(truth: np.ndarray) -> None:
    """Never worse than it, and its distance from the truth falls with the noise: consistent."""
    sizes = (1.0, 0.1, 0.01, 0.001)
    risks = np.array([ratios(truth, size, count=6).mean() for size in sizes])
    assert (risks < 1.0).all()
    biased = [ratios(truth, size, told=30.0, count=2).mean() for size in sizes]
    assert biased[-1] > 1.0, "a filter that does not know the noise went unseen"


def test_noise_that_neighbours_share_is_taken_for_noise() -> None:
    """As long as its sample shares it, too: one of independent noise of the same variance takes it for a signal."""
    offsets = list(itertools.product(range(4), repeat=2))
    blurred = [np.sum([np.roll(noise(seed), at, (0, 1)) for at in offsets], axis=0) for seed in (0, 1)]
    _, kept = filtered.shrunk(blurred[0], blurred[1], np.zeros((N, N, 3)), (True, True))
    _, planted = filtered.shrunk(blurred[0], 4 * noise(2), np.zeros((N, N, 3)), (True, True))
    assert max(kept) < 0.45
    assert max(planted) > 0.7, "noise taken for independent went unseen"


def test_edges_of_the_guide_are_kept() -> None:
    """A step that the guide has, too, is hardly blurred; one that it lacks is."""
    step = np.where(np.arange(N) < N // 2, -1.0, 1.0)[None, :, None] * np.ones((N, 1, 1))
    left = {}
    for name, guide in (("with", step), ("without", np.zeros_like(step))):
        *_, (_, _, smooth) = filtered.details(step, guide, OPEN)
        left[name] = np.abs(smooth - step).mean()
    assert left["with"] < 0.1
    assert left["without"] > 0.3


def test_a_map_that_wraps_may_be_turned() -> None:
    x, e, guide = noise(0), noise(1), noise(2)

    def differences(wrap: tuple[bool, bool]) -> float:
        turned = filtered.shrunk(np.roll(x, 5, 1), np.roll(e, 5, 1), np.roll(guide, 5, 1), wrap)[0]
        return float(np.abs(turned - np.roll(filtered.shrunk(x, e, guide, wrap)[0], 5, 1)).max())

    assert differences((False, True)) < 1e-9
    assert differences(OPEN) > 0.01
