"""What few samples tell of probabilities: pooled averages, the share of uniform draws, the tiles and the order of draws."""

from __future__ import annotations

import numpy as np
import pytest

from unrender.app.distributed.assignment import joined
from unrender.app.distributed.messages import Batch
from unrender.pixels import tiles as tiles_module
from unrender.pixels import uniform_share
from unrender.pixels.base import DrawStatistics
from unrender.pixels.pixel_statistics import pool
from unrender.pixels.uniform_share import MOST, SHARES, ShareEvidence


def tiles(*shapes: tuple[int, int], most: int = 10_000) -> tiles_module.Tiles:
    return tiles_module._cut(tuple(shapes), most)


# ---------------------------------------------------------------- pooling


def test_a_tile_without_paths_has_the_mean_of_its_block_and_one_of_many_its_own() -> None:
    found = tiles((2, 2), (2, 2))
    means = np.array([[1.0], [3.0], [5.0], [0.0], [9.0], [9.0], [9.0], [9.0]])
    counts = np.array([4.0, 4.0, 1e9, 0.0, 1.0, 1.0, 1.0, 1.0])
    pooled = pool(found, means, counts, 4.0)[:, 0]
    sums, weights = means[:, 0] * counts, counts
    overall = sums.sum() / weights.sum()
    view = (sums[:4].sum() + 4 * overall) / (weights[:4].sum() + 4)
    np.testing.assert_allclose(pooled[:4], (sums[:4] + 4 * view) / (weights[:4] + 4))
    assert pooled[3] == pytest.approx(view)
    assert pooled[2] == pytest.approx(5.0)
    other = (36 + 4 * overall) / 8
    np.testing.assert_allclose(pooled[4:], (9 + 4 * other) / 5)


def test_pooling_keeps_a_constant_and_a_map_that_nobody_has_seen_is_zero() -> None:
    found = tiles((5, 7), (1, 1), (3, 2))
    size = len(found.views)
    counts = np.random.default_rng(0).integers(0, 3, size).astype(float)
    np.testing.assert_allclose(pool(found, np.full((size, 3), 2.5), counts, 16.0), 2.5)
    assert not pool(found, np.zeros((size, 3)), np.zeros(size), 16.0).any()


def test_one_bright_path_raises_its_surroundings_and_does_not_darken_the_rest() -> None:
    found = tiles((8, 8))
    means = np.ones((64, 1))
    means[9] = 1000.0
    pooled = pool(found, means, np.ones(64), 16.0)[:, 0]
    assert pooled[9] > pooled[0] > pooled[2] > pooled[63] > 1
    assert pooled[9] < 200


# ---------------------------------------------------------------- the share of uniform draws


def evidence(samples: np.ndarray, density: np.ndarray) -> ShareEvidence:
    return uniform_share.observed(ShareEvidence(), np.stack([samples, samples]), density, 1.0)


def test_without_evidence_the_share_is_the_largest() -> None:
    assert uniform_share.choose(ShareEvidence()) == MOST == 0.8
    assert uniform_share.choose(evidence(np.zeros(50), np.ones(50))) == MOST


def test_many_samples_that_confirm_the_map_make_it_small() -> None:
    density = np.tile([0.05, 3.85], 4000)[: 4000 * 2]
    confirmed = evidence(np.where(density > 1, density, 1e-4), density)
    assert uniform_share.choose(confirmed) == SHARES[0]
    refuted = evidence(np.where(density < 1, 1.0, 1e-4), density)
    assert uniform_share.choose(refuted) == MOST


def test_few_samples_or_heavy_tails_keep_it_large() -> None:
    rng = np.random.default_rng(1)
    shares = []
    for count in (1, 20, 400):
        density = np.full(count, 2.0)
        shares.append(uniform_share.choose(evidence(rng.uniform(0.9, 1.1, count), density)))
    assert shares == sorted(shares, reverse=True)
    assert shares[0] >= 0.7
    assert shares[-1] <= 0.15
    heavy = np.full(400, 1e-3)
    heavy[0] = 1.0
    assert uniform_share.choose(evidence(heavy, np.full(400, 2.0))) >= 0.5
    # One factor that is not known is enough.
    both = uniform_share.observed(ShareEvidence(), np.stack([np.ones(400), heavy]), np.full(400, 2.0), 1.0)
    assert uniform_share.choose(both) >= 0.5


def test_where_the_map_draws_what_is_dear_more_stays_uniform() -> None:
    density = np.tile([0.5, 1.5], 500)
    found = evidence(density, density)
    shares = [uniform_share.choose(found, cost) for cost in (0.5, 1.0, 1.5, 10.0)]
    assert shares == sorted(shares)
    assert shares[0] < shares[-1] == MOST


def test_samples_tell_the_second_moment_under_other_probabilities() -> None:
    """Drawn with any probabilities p, over p: Σ s / p(λ). A sample that is not divided by its own is seen."""
    rng = np.random.default_rng(2)
    moments, density, drawn = rng.random(50) ** 4, rng.random(50) + 0.01, rng.random(50) + 0.2
    density, drawn = density / density.mean(), drawn / drawn.mean()
    chosen = rng.choice(50, size=20_000, p=drawn / 50)
    noisy = moments[chosen] * rng.exponential(size=len(chosen))
    exact = np.array([np.mean(moments / (share + (1 - share) * density)) for share in (*SHARES, 1.0)])

    def z(samples: np.ndarray) -> float:
        parts = [
            evidence(part, density[which]).moments[0] / len(part)
            for part, which in zip(np.split(samples, 20), np.split(chosen, 20), strict=True)
        ]
        return float(np.abs((np.mean(parts, axis=0) - exact) / (np.std(parts, axis=0, ddof=1) / np.sqrt(20))).max())

    assert z(noisy / drawn[chosen]) < 4
    assert z(noisy) > 6, "a planted error went unseen"


# ---------------------------------------------------------------- tiles and shares of views


@pytest.mark.parametrize("most", [3, 7, 60])
def test_every_pixel_is_found_in_its_tile(most: int) -> None:
    shapes = [(5, 7), (4, 4)]
    found = tiles(*shapes, most=most)
    for view, (height, width) in enumerate(shapes):
        pixels = np.arange(height * width, dtype=np.uint32)
        tile = found.locate(np.full(len(pixels), view), pixels)
        assert (found.views[tile] == view).all()
        for first, size, place in ((found.x, found.widths, pixels % width), (found.y, found.heights, pixels // width)):
            assert (first[tile] <= place).all()
            assert (place < first[tile] + size[tile]).all()


def test_what_workers_tell_comes_back_in_the_order_of_the_mini_batch() -> None:
    order = np.random.default_rng(3).permutation(7)
    parts = []
    for mine in (order[:4], order[4:]):
        positions = np.concatenate([mine, [0, 0]]).astype(np.uint32)
        weights = np.concatenate([np.ones(len(mine)), [0, 0]])
        values = np.repeat(np.where(weights > 0, positions + 1.0, -1.0)[:, None], 3, axis=1)
        views = np.zeros(len(positions), np.uint32)
        parts.append((Batch(views, views, weights, positions, 7), DrawStatistics(values, 2 * values)))
    found = joined(parts)
    assert found is not None
    np.testing.assert_array_equal(found.squares[:, 0], np.arange(1, 8))
    np.testing.assert_array_equal(found.moments, 2 * found.squares)
    assert joined([]) is None
