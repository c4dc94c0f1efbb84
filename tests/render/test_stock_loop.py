"""The loop of Mitsuba that benchmarks write by hand, with known values, expressions and priors of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

import unrender as ur
from benchmarks import stock_loop
from benchmarks.internals import dr, mi
from benchmarks.stock_loop import StockViews, priors
from benchmarks.suite.features import run as features
from tiers import slow
from unrender.core import trees
from unrender.core.random import Key
from unrender.estimators.penalties import penalized

REPEATS, SPP = 5, 64
TEXTS = {features.LEFT: "mix([0.1, 0.1, 0.2], [0.9, 0.8, 0.6], pattern)", features.RIGHT: "0.8 * pattern"}


def problem(expressions: dict[str, str], worlds: tuple[Any, ...]) -> ur.Problem:
    """A pattern of 2 × 2 texels that two textures are derived from, and a lamp with a prior, in pictures with known values."""
    pattern = ur.Parameter("pattern", initial=np.full((2, 2, 1), 0.5), bounds=(0.0, 1.0))
    lamp = ur.Parameter(features.NEAR, initial=0.75, prior={"near": 3.0, "std": 0.03})
    truth = {"pattern": [[[0.2], [0.9]], [[0.7], [0.4]]], features.NEAR: [1.5] * 3}
    return features._made([pattern, lamp], truth, worlds, spp=64, expressions=expressions)


def by_hand(made: ur.Problem, with_priors: bool = True, repeats: int = REPEATS) -> np.ndarray:
    """Gradients of the hand-written loop, (repeats, 7)."""
    stock, rows = StockViews(made), []
    for seed in range(repeats):
        values = {key: mi.TensorXf(value) for key, value in made.initial().items()}
        dr.enable_grad(*values.values())
        stock.write(values)
        stock.backward(seed, 0, range(len(made.views)), SPP, priors(made, values) if with_priors else 0.0)
        rows.append(trees.ravel({key: dr.grad(value) for key, value in values.items()}))
    return np.array(rows)


def by_library(made: ur.Problem, repeats: int = REPEATS) -> np.ndarray:
    """Gradients of `PathGradient`, (repeats, 7)."""
    estimator, at, rows = ur.PathGradient(spp=SPP), made.initial(), []
    state = estimator.init(made, at)
    for seed in range(repeats):
        estimate, _ = estimator.estimate(made, at, state, Key(seed))
        gradient = penalized(estimate, made, at).gradient
        rows.append(trees.ravel({key: gradient[key] for key in at}))
    return np.array(rows)


@pytest.mark.parametrize("small", [True, slow(False)])
def test_the_gradient_of_the_loop_is_that_of_path_gradients(small: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Expressions, a world and a prior, each left out in turn as a planted fault; in the quick tier, the prior."""
    monkeypatch.setattr(features, "_SIDE", 6 if small else 12)
    monkeypatch.setattr(features, "_TEXELS", 2)
    worlds = ({},) if small else ({}, {features.FAR: [0.0] * 3})
    made, repeats = problem(TEXTS, worlds), 4 if small else REPEATS
    expected = by_library(made, repeats)

    def agrees(found: np.ndarray) -> bool:
        _, p = stats.ttest_ind(found, expected, equal_var=False)
        return bool((np.asarray(p) > 1e-3 / expected.shape[1]).all())

    assert agrees(by_hand(made, repeats=repeats))
    assert not agrees(by_hand(made, with_priors=False, repeats=2 if small else 3))
    if small:
        return
    same = [ur.View(view.reference) for view in made.original_views]
    assert not agrees(by_hand(made.replaced(views=same), repeats=3))
    other = {**TEXTS, features.RIGHT: "0.6 * pattern"}
    assert not agrees(by_hand(problem(other, worlds).replaced(views=made.original_views), repeats=3))


def test_worlds_that_differ_in_a_texel_are_rendered_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy shortens the text of arrays above 1000 elements."""
    monkeypatch.setattr(features, "_SIDE", 4)
    monkeypatch.setattr(features, "_TEXELS", 32)
    one = np.full((32, 32, 3), 0.5)
    other = one.copy()
    other[16, 16] = 0.9
    worlds = tuple({features.LEFT: value} for value in (one, one.copy(), other))
    unknown = ur.Parameter(features.NEAR, initial=0.75)
    made = features._made([unknown], {features.NEAR: [1.5] * 3}, worlds, spp=4)
    stock = StockViews(made)
    assert [index for index, *_ in stock._views] == [1, 1, 2]
    monkeypatch.setattr(stock_loop, "_equal", lambda one, other: repr(one) == repr(other))
    assert [index for index, *_ in StockViews(made)._views] == [1, 1, 1], "planted: texts of arrays"
