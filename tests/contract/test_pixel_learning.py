"""Adaptive pixels on problems whose answers are known: what samples tell, what is learnt, and input of little use."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import unrender as ur
from analytic import problem
from tests.analytic import AnalyticRenderer
from unrender.core.random import Key
from unrender.estimators.sample_groups import GradientRequest
from unrender.images.base import PlainState
from unrender.pixels import pixel_statistics
from unrender.pixels.pixel_statistics import pool
from unrender.pixels.tiles import cut
from unrender.runs.folder.state import pack, unpack
from unrender.scene.executor import LOCAL


def few_pixels(sparse: float = 0.1, views: int = 1, grain: float = 0.0) -> ur.Problem:
    """A picture of 8 × 8 pixels, few of which know of the parameters."""
    rng = np.random.default_rng(5)
    matrix = rng.random((64 * 3, 4)) * np.repeat(rng.random(64) < sparse, 3)[:, None]
    renderer = AnalyticRenderer({"x": np.full(4, 0.6)}, matrix, 0.1, 0.5, grain, shape=(8, 8), sensors=views)
    reference = renderer.exact({"x": np.full(4, 0.9)})
    seen = [ur.View(reference, sensor=view) for view in range(views)]
    return ur.Problem(renderer, [ur.Parameter("x", 0.5)], seen)


def steps(asked: ur.Problem, estimator: Any, count: int, state: Any = None, first: int = 0) -> tuple[list[Any], Any]:
    state = estimator.init(asked, asked.initial()) if state is None else state
    found = []
    for step in range(first, first + count):
        estimate, state = estimator.estimate(asked, asked.initial(), state, Key(0, step))
        found.append(estimate)
    return found, state


@pytest.mark.parametrize("spp", [1, 2])
def test_draws_tell_both_factors_of_their_pixels(spp: int) -> None:
    """E[(∂L/∂I)²] and Σ_k E[(∂I/∂θ_k)²] of each pixel; not with the draw's weight left in."""
    asked = problem(noise=0.8)
    renderer, at = asked.renderer, asked.initial()
    assert isinstance(renderer, AnalyticRenderer)
    sampler = ur.pixels.Adaptive(64, denoiser="none", uniform=0.3)
    _, state = sampler.draw(asked, at, sampler.init(asked, at), Key(9))
    scales = pixel_statistics.scales(at, {})
    sums, weighted, counts = np.zeros((2, 20, 16)), np.zeros((20, 16)), np.zeros((20, 16))
    for step in range(400):
        key = Key(1, step)
        tangents = pixel_statistics.random_tangents(asked, at, scales, key.fold(3))
        batch = dataclasses.replace(sampler.redraw(asked, state, key), tangents=tangents)
        assert batch.sample is not None
        request = GradientRequest(at, ur.images.Plain(), PlainState(), spp, key, batch=batch)
        draws = LOCAL.estimate_gradient(asked, request).draws
        assert draws is not None
        told = draws.squares.sum(axis=1)
        np.add.at(sums[0][step % 20], batch.sample.pixels, told)
        np.add.at(sums[1][step % 20], batch.sample.pixels, draws.moments.sum(axis=1))
        np.add.at(weighted[step % 20], batch.sample.pixels, told * batch.sample.weights[:, 0] ** 2)
        np.add.at(counts[step % 20], batch.sample.pixels, 1)
    image, reference = renderer.exact(at), np.asarray(asked.views[0].reference)
    variance = (renderer.noise * (image - renderer.offset.reshape(image.shape))) ** 2 / 3
    squares = 4 * ((image - reference) ** 2 + variance) / 48**2
    moments = (renderer.matrix**2).sum(axis=1).reshape(image.shape) * (1 + renderer.noise**2 / 3)

    def z(values: np.ndarray, exact: np.ndarray) -> float:
        means = values / counts
        error = means.std(axis=0, ddof=1) / np.sqrt(20)
        return float(np.abs((means.mean(axis=0) - exact.sum(axis=2).ravel()) / error).max())

    assert z(sums[0], squares) < 4.5
    assert z(sums[1], moments) < 4.5
    assert z(weighted, squares) > 10, "a planted error went unseen"


def test_at_first_the_probabilities_are_at_least_four_fifths_of_uniform_ones_and_then_by_the_evidence() -> None:
    asked = few_pixels()
    estimator = ur.PathGradient(pixels=ur.pixels.Adaptive(128, denoiser="pooling"), spp=2)
    found, state = steps(asked, estimator, 1)
    assert found[0].info["pixel_probability"][0].min() >= 0.8 - 1e-6
    found, state = steps(asked, estimator, 60, state, 1)
    assert state.pixels.uniform < 0.5
    probability = found[-1].info["pixel_probability"][0]
    assert probability.mean() == pytest.approx(1.0)
    renderer = asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    known = (renderer.matrix.reshape(64, -1) > 0).any(axis=1).reshape(8, 8)
    assert probability[known].mean() > 2 * probability[~known].mean()


def test_a_share_that_was_given_stays() -> None:
    _, state = steps(
        few_pixels(), ur.PathGradient(pixels=ur.pixels.Adaptive(32, uniform=0.25, denoiser="none"), spp=2), 9
    )
    assert state.pixels.uniform == 0.25
    assert state.pixels.shares.min() == pytest.approx(0.25)


def test_maps_count_the_samples_of_the_first_steps_and_of_one_between_updates() -> None:
    asked = problem(noise=0.9)
    for learns in (True, False):
        sampler = ur.pixels.Adaptive(10, refresh=6, samples=32, learn_from_draws=learns, denoiser="none")
        estimator = ur.PathGradient(pixels=sampler, spp=2)
        state, learnt = None, []
        for step in range(8):
            before = 0.0 if state is None else state.pixels.counts[0].sum()
            _, state = steps(asked, estimator, 1, state, step)
            learnt.append(round(state.pixels.counts[0].sum() - before))
        assert [count > 4 for count in learnt] == (
            [True] * 4 + [False, False, True, False] if learns else [True] + [False] * 5 + [True, False]
        )


def test_probabilities_go_with_one_over_the_root_of_the_cost() -> None:
    """Where the renderer counts the vertices of paths: here six in the second view, none in the first."""

    class Counting(AnalyticRenderer):
        def vertices(self, parameters: Any, request: Any) -> np.ndarray:
            del parameters
            return np.repeat(np.where(np.asarray(request.sensors) == 1, 6.0, 0.0)[:, None], 3, axis=1)

    base = few_pixels(1.0, views=2)
    inner = base.renderer
    assert isinstance(inner, AnalyticRenderer)
    counting = Counting({"x": np.full(4, 0.6)}, inner.matrix, 0.1, 0.5, shape=(8, 8), sensors=2)
    asked = ur.Problem(counting, base.parameters, base.views)
    shares = []
    for by_cost in (False, True):
        sampler = ur.pixels.Adaptive(128, samples=128, uniform=1e-9, denoiser="none", by_cost=by_cost)
        batch, state = sampler.draw(asked, asked.initial(), sampler.init(asked, asked.initial()), Key(0))
        shares.append(state.shares)
        assert batch.samples == 2 * 128 + 128 * by_cost
    tiles = cut(asked, 128)
    known = pool(tiles, np.repeat([0.0, 6.0], 64)[:, None], np.ones(128), 4.0)[:, 0]
    ratio = shares[1] / shares[0] * np.sqrt(1 + known / 2)
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)
    assert known[64:].min() > 3 > known[:64].max()


def test_a_run_goes_on_from_a_packed_state_to_the_bit() -> None:
    asked = few_pixels(views=2)
    estimator = ur.PathGradient(pixels=ur.pixels.Adaptive(48, refresh=5, denoiser="pooling"), spp=2)
    whole, _ = steps(asked, estimator, 14)
    for at in (2, 7):
        _, state = steps(asked, estimator, at)
        rest, _ = steps(asked, estimator, 14 - at, unpack(pack(state)), at)
        for ours, theirs in zip(rest, whole[at:], strict=True):
            np.testing.assert_array_equal(ours.gradient["x"], theirs.gradient["x"])


# ---------------------------------------------------------------- input of little use


def test_one_pixel_a_step_and_more_than_there_are() -> None:
    asked = few_pixels()
    for count in (1, 200):
        found, state = steps(asked, ur.PathGradient(pixels=ur.pixels.Adaptive(count, denoiser="pooling"), spp=2), 12)
        assert all(np.isfinite(each.gradient["x"]).all() for each in found)
        assert 0.1 <= state.pixels.shares.min() <= 1


def test_maps_that_are_all_zero_are_uniform() -> None:
    """No pixel knows of the parameter: its gradient is zero, and all pixels are alike."""
    renderer = AnalyticRenderer({"x": np.full(4, 0.6)}, np.zeros((64 * 3, 4)), 0.1, shape=(8, 8))
    asked = ur.Problem(renderer, [ur.Parameter("x", 0.5)], [ur.View(np.full((8, 8, 3), 0.4))])
    for denoiser in ("none", "pooling"):
        found, state = steps(asked, ur.PathGradient(pixels=ur.pixels.Adaptive(32, denoiser=denoiser), spp=2), 8)
        assert not any(each.gradient["x"].any() for each in found)
        np.testing.assert_allclose(state.pixels.shares, 1.0)


def test_a_view_that_tells_nothing_is_still_drawn_and_hardly() -> None:
    """Its mask leaves next to nothing of it; one that leaves nothing is refused."""
    shown = few_pixels(0.5, views=2)
    mask = np.zeros((8, 8))
    mask[0, 0] = 1e-3
    masked = [shown.views[0], dataclasses.replace(shown.views[1], mask=mask)]
    asked = ur.Problem(shown.renderer, [ur.Parameter("x", 0.5)], masked)
    estimator = ur.PathGradient(pixels=ur.pixels.Adaptive(64, denoiser="none"), spp=2)
    found, state = steps(asked, estimator, 45)
    probability = found[-1].info["pixel_probability"]
    np.testing.assert_allclose(probability[1], state.pixels.uniform, rtol=0.05)
    assert probability[0].mean() > 1.2


def test_a_parameter_that_no_pixel_knows_of_changes_nothing_for_the_others() -> None:
    base = few_pixels(0.3)
    renderer = base.renderer
    assert isinstance(renderer, AnalyticRenderer)
    matrix = np.concatenate([renderer.matrix, np.zeros((64 * 3, 5))], axis=1)
    wider = AnalyticRenderer({"x": np.full(4, 0.6), "y": np.zeros(5)}, matrix, 0.1, 0.5, shape=(8, 8))
    asked = ur.Problem(wider, [ur.Parameter("x", 0.5), ur.Parameter("y", 0.5)], base.views)
    estimator = ur.PathGradient(pixels=ur.pixels.Adaptive(48, denoiser="none"), spp=2)
    found, state = steps(asked, estimator, 30)
    assert not found[-1].gradient["y"].any()
    assert np.isfinite(found[-1].gradient["x"]).all()
    assert np.ptp(state.pixels.shares) > 0.5


def test_the_size_of_a_mini_batch_without_a_number() -> None:
    from unrender.pixels.adaptive import default_count

    assert default_count(few_pixels(views=2)) == 128
    found, _ = steps(few_pixels(), ur.PathGradient(pixels=ur.pixels.Adaptive(denoiser="none"), spp=2), 1)
    assert found[0].info["samples"] >= 2 * 64
