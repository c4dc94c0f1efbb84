"""The probabilities of emitters, from what connections tell: formulas, the share of the scene's own, and input of little use."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.core.errors import InputError
from unrender.estimators.emitter_selection import EmitterState, connections, learned
from unrender.images.base import ImageEstimate
from unrender.methods.base import method
from unrender.pixels.uniform_share import MOST, SHARES
from unrender.rendering.renderer import EmitterMoments, RenderSession

MOMENTS = np.array([4.0, 1.0, 0.25, 0.0])


def told(state: EmitterState, moments: np.ndarray, samples: float = 1e6) -> EmitterMoments:
    """What so many equal samples of each emitter tell of second moments M: Σ y = M / p."""
    sums = np.divide(moments, state.probabilities, out=np.zeros(len(moments)), where=state.probabilities > 0)
    return EmitterMoments(sums, sums**2 / samples)


def fresh(start: np.ndarray | None = None) -> EmitterState:
    return EmitterState(np.full(4, 0.25) if start is None else start, 0, np.zeros(4))


def taught(state: EmitterState, moments: np.ndarray, times: int, samples: float = 1e6) -> EmitterState:
    for _ in range(times):
        state = learned(state, told(state, moments, samples))
    return state


def test_probabilities_go_by_the_root_of_the_second_moments_and_keep_a_share_of_the_scene_s_own() -> None:
    before = fresh()
    assert not before.known
    np.testing.assert_array_equal(before.probabilities, before.start)
    state = taught(before, MOMENTS, 1)
    assert state.uniform == MOST, "no sample has confirmed it yet"
    root = np.sqrt(MOMENTS) / np.sqrt(MOMENTS).sum()
    np.testing.assert_allclose(state.probabilities, 0.8 * 0.25 + 0.2 * root)
    state = taught(state, MOMENTS, 5)
    assert state.uniform == SHARES[0]
    np.testing.assert_allclose(state.probabilities, 0.1 * 0.25 + 0.9 * root)
    # Of all probabilities with that share: less than uniform ones have, and than powers, say, have.
    assert (MOMENTS / state.probabilities).sum() < 0.6 * (MOMENTS / 0.25).sum()


def test_what_was_learnt_does_not_depend_on_the_probabilities_that_it_was_drawn_with() -> None:
    skewed = replace(fresh(), moments=np.array([1.0, 50.0, 1.0, 1.0]), uniform=0.3)
    one, other = (learned(state, told(state, MOMENTS)) for state in (fresh(), skewed))
    added = other.moments - 0.8 * skewed.moments
    np.testing.assert_allclose(added, one.moments)
    blind = learned(skewed, EmitterMoments(MOMENTS / 0.25, MOMENTS**2))
    assert np.abs(blind.moments - 0.8 * skewed.moments - one.moments).max() > 0.1, "a planted error went unseen"


def test_few_effective_samples_confirm_nothing() -> None:
    assert taught(fresh(), MOMENTS, 10, samples=1.0).uniform >= 0.6
    assert taught(fresh(), MOMENTS, 10, samples=1e4).uniform == SHARES[0]


def test_moments_of_zero_or_none_leave_the_probabilities_as_they_are() -> None:
    state = taught(fresh(), MOMENTS, 3)
    silent = learned(state, EmitterMoments(np.zeros(4), np.zeros(4)))
    np.testing.assert_array_equal(silent.probabilities, state.probabilities)
    assert learned(state, None).step == silent.step == state.step + 1
    overflown = learned(state, EmitterMoments(MOMENTS, np.full(4, np.inf)))
    np.testing.assert_array_equal(overflown.probabilities, state.probabilities)
    np.testing.assert_array_equal(taught(fresh(), np.zeros(4), 3).probabilities, fresh().start)


def test_the_scene_s_weights_are_where_it_starts_and_what_is_kept() -> None:
    start = np.array([0.6, 0.2, 0.0, 0.2])
    state = taught(fresh(start), np.array([1.0, 1.0, 0.0, 4.0]), 8)
    assert state.probabilities[2] == 0, "the scene never takes it"
    assert (state.probabilities >= 0.1 * start - 1e-12).all()
    assert state.probabilities.sum() == pytest.approx(1)
    np.testing.assert_allclose(state.probabilities, 0.1 * start + 0.9 * np.array([0.25, 0.25, 0, 0.5]))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"emitters": "power"}, "emitters must be"),
        ({"emitters": "adaptive", "spp": 1}, "needs sample groups"),
        ({"emitters": "adaptive", "spp": 4, "adjoint_spp": 2}, "needs sample groups"),
        ({"emitters": "adaptive", "pixels": ur.pixels.AdaptiveCounts()}, "AdaptiveCounts"),
    ],
)
def test_what_does_not_go_with_it_is_refused(options, words: str) -> None:
    with pytest.raises(InputError, match=words):
        ur.PathGradient(**options)


def test_renderers_without_emitters_refuse() -> None:
    renderer = AnalyticRenderer({"x": np.full(4, 0.6)}, np.ones((12, 4)), 0.1, 0.5, 0.0, shape=(2, 2))
    asked = ur.Problem(renderer, [ur.Parameter("x", 0.5)], [ur.View(np.ones((2, 2, 3)))])
    with pytest.raises(InputError, match='leave emitters="scene"'):
        ur.PathGradient(emitters="adaptive").init(asked, asked.initial())


def test_methods_with_path_gradients_take_it() -> None:
    for name in ("plain", "rcv", "adaptive"):
        estimator, _ = method(name).start({"emitters": "adaptive"})
        assert isinstance(estimator, ur.PathGradient)
        assert estimator.emitters == "adaptive"
        with pytest.raises(InputError, match="scene or adaptive"):
            method(name).start({"emitters": "power"})


class Recorder:
    """A session that keeps what it is asked, and knows the second moments of its pixels."""

    def __init__(self, moments: np.ndarray):
        self.moments = moments
        self.asked: tuple[np.ndarray, np.ndarray] | None = None

    def tangent_moment(self, parameters: Any, paths: Any, tangents: Any) -> np.ndarray:
        return self.moments

    def emitters(self) -> np.ndarray:
        return np.full(2, 0.5)

    def emitter_moments(self, parameters: Any, paths: Any, tangents: Any, weights: Any, noise: Any) -> EmitterMoments:
        self.asked = weights, noise
        return EmitterMoments(np.ones(2), np.ones(2))


def test_noise_counts_by_the_derivatives_of_the_other_groups() -> None:
    """n² = h² B / n, for h = ∂(loss derivative)/∂I: of L2 the same in every pixel whose variance is above the floor."""
    rng = np.random.default_rng(0)
    images, moments = rng.uniform(0.5, 1.5, (4, 3, 5, 3)), rng.uniform(0, 1, (4, 3, 5, 3))
    found, session = ImageEstimate(images, None), Recorder(moments)
    weights = 0.7 * (found.others() - 0.2)
    connections(cast("RenderSession", session), {}, {"x": 1.0}, found, weights, 8)
    assert session.asked is not None
    assert session.asked[0] is weights
    others = (moments.sum(axis=0) - moments) / 3
    clear = np.var(found.others(), axis=0) > 0.1 * np.var(found.others(), axis=0).mean()
    assert clear.mean() > 0.8
    expected = np.sqrt(0.7**2 * others / 6)
    np.testing.assert_allclose(session.asked[1][:, clear], expected[:, clear], rtol=1e-6)
    own = np.sqrt(0.7**2 * moments / 6)
    assert np.abs(session.asked[1][:, clear] / own[:, clear] - 1).max() > 0.1, "a planted error went unseen"
