"""Mini-batches of whole views, drawn by what their gradients tell, on a problem whose gradient is known."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from analytic import exact_gradient, problem

import unrender as ur
from unrender.core.random import Key
from unrender.pixels.base import DrawStatistics
from unrender.pixels.views import Views, ViewsState, inclusion_probabilities

WEIGHTS = np.array([8.0, 2.0, 1.0, 1.0, 1e-6])


def weighted() -> ur.Problem:
    """Five views of one picture; the last of hardly any weight, as if it were black."""
    found = problem(views=5, noise=0.3)
    views = [dataclasses.replace(view, weight=float(w)) for view, w in zip(found.given_views, WEIGHTS, strict=True)]
    return ur.Problem(found.renderer, found.parameters, views, found.loss)


def flat(gradient: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(g) for g in gradient.values()])


class EqualWeights(Views):
    """A planted fault: weighted as if all views were equally likely."""

    def draw(self, problem: ur.Problem, parameters: Any, state: ViewsState | None, key: Key) -> Any:
        batch, state = super().draw(problem, parameters, state, key)
        assert batch.sample is not None
        equal = dataclasses.replace(batch.sample, weights=batch.sample.weights * 0 + 5 / self.count)
        return dataclasses.replace(batch, sample=equal), state


def test_views_are_drawn_by_what_their_gradients_tell_without_bias() -> None:
    asked = weighted()
    at, exact = asked.initial(), flat(exact_gradient(asked, asked.initial()))

    def rows(sampler: Views, state: Any) -> np.ndarray:
        estimator = ur.PathGradient(pixels=sampler, spp=2)
        return np.array([flat(estimator.estimate(asked, at, state, Key(seed))[0].gradient) for seed in range(160)])

    sampler = Views(2, by="gradients", uniform=0.1)
    estimator = ur.PathGradient(pixels=sampler, spp=2)
    state = estimator.init(asked, at)
    first = dataclasses.replace(state)
    for step in range(60):
        _, state = estimator.estimate(asked, at, state, Key(7, step))
    learnt = state.pixels.density()
    assert learnt[0] > 2 * learnt[1:4].max()  # of few pixels along one tangent each: by half
    state = dataclasses.replace(
        state, pixels=dataclasses.replace(state.pixels, step=61, counts=state.pixels.counts + 1)
    )
    found, even, wrong = (
        rows(sampler, state),
        rows(Views(2), first),
        rows(EqualWeights(2, by="gradients", uniform=0.1), state),
    )

    def worst(each: np.ndarray) -> float:
        return float(np.abs((each.mean(0) - exact) / (each.std(0, ddof=1) / np.sqrt(len(each)))).max())

    assert worst(found) < 3.7
    assert worst(wrong) > 3.7, "a planted fault went unseen"
    assert found.var(0).sum() < 0.3 * even.var(0).sum()


def test_inclusion_probabilities() -> None:
    np.testing.assert_allclose(inclusion_probabilities(np.array([1.0, 1, 2, 16]), 2), [0.25, 0.25, 0.5, 1])
    np.testing.assert_allclose(inclusion_probabilities(np.array([1.0, 3]), 5), [1, 1])
    np.testing.assert_allclose(inclusion_probabilities(np.array([1.0, 3]), 1), [0.25, 0.75])


def test_views_of_which_nothing_is_known_or_seen_are_equally_likely() -> None:
    """Also where nothing but zeros, or values that are not finite, were seen; one black view among others is drawn now and then."""
    asked, sampler = weighted(), Views(2, by="gradients")
    one = ur.PathGradient(pixels=Views(1, by="gradients"), spp=2)
    assert np.isfinite(
        flat(one.estimate(asked, asked.initial(), one.init(asked, asked.initial()), Key(0))[0].gradient)
    ).all()
    state = sampler.init(asked, asked.initial())
    assert state is not None
    for value in (0.0, np.nan, np.inf):
        told = state
        for step in range(6):
            sample = sampler.redraw(asked, told, Key(step)).sample
            assert sample is not None
            seen = np.full((len(sample.views), 3), value)
            told = sampler.learn(asked, told, sample, DrawStatistics(seen, seen))
            assert told is not None
            np.testing.assert_array_equal(told.density(), 1)
            assert told.uniform == 0.8
    whole = Views(9, by="gradients")
    sample = whole.redraw(asked, whole.init(asked, asked.initial()), Key(0)).sample
    assert sample is not None
    assert (np.asarray(sample.weights) == 1).all()
    dark = dataclasses.replace(state, totals=np.array([5.0, 5, 5, 5, 0]), counts=np.full(5, 5.0), uniform=0.1)
    assert 0.03 < sampler._probabilities(dark)[4] * 5 / 2 < 0.6
    with pytest.raises(ur.InputError, match="Views: by"):
        Views(2, by="loss")  # pyright: ignore[reportArgumentType]
