"""Mini-batches of whole views, on a problem whose gradient is known."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.contract.analytic import exact_gradient, problem
from unrender.core.random import Key
from unrender.pixels.uniform import Views

WEIGHTS = np.array([8.0, 2.0, 1.0, 1.0, 1e-6])


def weighted() -> ur.Problem:
    """Five views of one picture; the last of hardly any weight, as if it were black."""
    found = problem(views=5, noise=0.3)
    views = [dataclasses.replace(view, weight=float(w)) for view, w in zip(found.original_views, WEIGHTS, strict=True)]
    return ur.Problem(found.renderer, found.parameters, views, found.loss)


def flat(gradient: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(g) for g in gradient.values()])


class FewOfTheFirst(Views):
    """A planted fault: the weights of equally likely views, but the first is drawn half as often."""

    def draw(self, problem: ur.Problem, parameters: Any, state: None, key: Key) -> Any:
        batch, state = super().draw(problem, parameters, state, key)
        assert batch.sample is not None
        if int(np.asarray(batch.sample.views).min()) == 0 and key.uint32() % 2:
            return super().draw(problem, parameters, state, key.fold(1))
        return batch, state


def test_views_are_drawn_without_bias() -> None:
    asked = weighted()
    at, exact = asked.initial(), flat(exact_gradient(asked, asked.initial()))

    def worst(sampler: Views) -> float:
        estimator = ur.PathGradient(pixels=sampler, spp=2)
        state = estimator.init(asked, at)
        each = np.array([flat(estimator.estimate(asked, at, state, Key(seed))[0].gradient) for seed in range(240)])
        return float(np.abs((each.mean(0) - exact) / (each.std(0, ddof=1) / np.sqrt(len(each)))).max())

    assert worst(Views(2)) < 3.7
    assert worst(FewOfTheFirst(2)) > 3.7, "a planted fault went unseen"


def test_a_step_has_different_views_or_all_of_them() -> None:
    asked = weighted()
    for seed in range(20):
        sample = Views(3).redraw(asked, None, Key(seed)).sample
        assert sample is not None
        assert len(np.unique(sample.views)) == 3
        np.testing.assert_allclose(np.asarray(sample.weights), 5 / 3, rtol=1e-6)
    sample = Views(9).redraw(asked, None, Key(0)).sample
    assert sample is not None
    assert len(np.unique(sample.views)) == 5
    assert (np.asarray(sample.weights) == 1).all()
    with pytest.raises(ur.InputError, match="Views: count"):
        Views(0)
