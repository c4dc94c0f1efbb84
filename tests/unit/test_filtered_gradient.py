"""FilteredGradient: the noise that it measures, what becomes of it, and what it passes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tiers import slow
from unrender.core import tables
from unrender.core.random import Key
from unrender.estimators.capabilities import FreshGradient
from unrender.rendering.numpy.linear import AnalyticRenderer

SIDE = 12
CV = ur.images.RecursiveControlVariate
TRUTHS = {
    "smooth": 0.5 + 0.2 * np.sin(np.arange(SIDE) / 4)[:, None] + 0.1 * np.cos(np.arange(SIDE) / 3),
    "board": 0.35 + 0.3 * (np.indices((SIDE, SIDE)).sum(0) % 2),
}


def problem(truth: str = "smooth", loss: Any = None, noise: float = 0.5) -> ur.Problem:
    """A map of one channel, each texel seen by one pixel, three times; and a number that darkens nothing but adds to all."""
    values = {"map": TRUTHS[truth][..., None], "add": np.array([0.1])}
    seen = np.concatenate([np.repeat(np.eye(SIDE * SIDE), 3, axis=0), np.ones((3 * SIDE * SIDE, 1))], axis=1)
    renderer = AnalyticRenderer(values, seen, 0.0, noise, grain=noise, shape=(SIDE, SIDE))
    return ur.Problem(
        renderer,
        [ur.Parameter("map", initial=0.5, bounds=(0, 1)), ur.Parameter("add", initial=0.1)],
        [ur.View(renderer.exact(values))],
        loss=loss or ur.losses.L2(),
        truth=values,
    )


def exact(truth: str) -> np.ndarray:
    """The gradient of the map without noise."""
    return np.asarray(ur.estimate(problem(truth, noise=0.0), ur.PathGradient(spp=2)).gradient["map"])


def squared_errors(truth: str, estimator: Any, count: int = 20) -> np.ndarray:
    """(count,) of independent first estimates."""
    asked, right = problem(truth), exact(truth)
    found = [ur.estimate(asked, estimator, seed=seed).gradient["map"] - right for seed in range(count)]
    return np.square(found).sum(axis=(1, 2, 3))


@pytest.mark.parametrize(("truth", "most"), [("smooth", 0.5), ("board", 1.0)])
def test_it_is_nearer_to_the_gradient_than_the_mean_of_the_halves(truth: str, most: float) -> None:
    plain, filtered = (
        squared_errors(truth, estimator)
        for estimator in (ur.PathGradient(spp=8), ur.estimators.FilteredGradient(ur.PathGradient(spp=4)))
    )
    error = np.hypot(plain.std(ddof=1) * most, filtered.std(ddof=1)) / np.sqrt(len(plain))
    assert filtered.mean() < most * plain.mean() - 3 * error
    shuffled = squared_errors(truth, ur.estimators.FilteredGradient(Shared(ur.PathGradient(spp=4))))
    assert shuffled.mean() > most * plain.mean(), "halves that share their samples went unseen"


class Shared:
    """A fault: the two halves of a step have the same samples."""

    def __init__(self, inner: Any):
        self.inner, self.provides = inner, inner.provides

    def init(self, problem: ur.Problem, parameters: Any) -> Any:
        return self.inner.init(problem, parameters)

    def estimate(self, problem: ur.Problem, parameters: Any, state: Any, key: Key) -> Any:
        return self.inner.estimate(problem, parameters, state, replace(key, stream=0))


@pytest.mark.parametrize("truth", TRUTHS)
def test_it_is_consistent(truth: str) -> None:
    """Its error falls with that of the mean of the halves, in proportion; a smoothing that does not know the noise keeps its bias."""
    few, many = (
        squared_errors(truth, ur.estimators.FilteredGradient(ur.PathGradient(spp=n)), 10).mean() for n in (4, 1024)
    )
    assert many < 0.02 * few
    blurred = np.asarray(ur.preconditioners.LargeSteps(1.0).apply(exact(truth)))
    assert np.square(blurred - exact(truth)).sum() > 5 * many, "a bias that stays went unseen"


@pytest.mark.parametrize("inner", [slow(ur.PathGradient(spp=2)), ur.PathGradient(CV(), spp=2)], ids=["plain", "rcv"])
def test_the_halves_tell_the_noise_memories_included(inner: Any) -> None:
    """After five steps, the variance from the halves is that of their mean over runs; halves with one memory would tell less."""
    asked, means, halves, planted = problem(), [], [], []
    outer = ur.estimators.FilteredGradient(inner)
    at = asked.initial()
    for seed in range(60):
        state = outer.init(asked, at)
        for step in range(5):
            _, state = outer.estimate(asked, at, state, Key(seed, step))
        pair = [
            inner.estimate(asked, at, half, Key(seed, 5).fold(n))[0].gradient["map"]
            for n, half in enumerate(state.halves)
        ]
        other = inner.estimate(asked, at, state.halves[0], Key(seed, 5).fold(1))[0].gradient["map"]
        means.append(0.5 * (pair[0] + pair[1]))
        halves.append(0.25 * np.square(pair[0] - pair[1]))
        planted.append(0.25 * np.square(pair[0] - other))
    whole = np.var(means, axis=0, ddof=1).mean()
    ratio = np.mean(halves, axis=(1, 2, 3)) / whole
    error = np.hypot(ratio.std(ddof=1) / np.sqrt(len(ratio)), np.sqrt(2 / (len(means) * SIDE * SIDE)))
    assert abs(ratio.mean() - 1) < 4 * error
    if isinstance(inner.image, CV):
        assert np.mean(planted) / whole < 1 - 8 * error, "a memory that the halves share went unseen"


def test_one_estimate_suffices_where_it_tells_its_variance() -> None:
    asked, inner = problem(), ur.MetaEstimator(coupled=True, spp=2)
    outer = ur.estimators.FilteredGradient(inner)
    state = outer.init(asked, asked.initial())
    found, after = outer.estimate(asked, asked.initial(), state, Key(3))
    assert len(after.halves) == 1
    assert found.info["samples"] == inner.estimate(asked, asked.initial(), state.halves[0], Key(3))[0].info["samples"]
    assert max(found.info["kept"]["map"]) < 1
    assert found.preconditioned


def test_what_is_no_map_and_what_is_fresh_are_passed_on() -> None:
    asked, inner = problem(), ur.PathGradient(CV(), spp=2, fresh_from=8)
    outer = ur.estimators.FilteredGradient(inner)
    at = asked.initial()
    state, found = outer.init(asked, at), None
    for step in range(9):
        before = state
        found, state = outer.estimate(asked, at, before, Key(0, step))
        assert (found.get(FreshGradient) is None) == (step < 8)
    assert found is not None
    pair = [inner.estimate(asked, at, half, Key(0, 8).fold(n))[0] for n, half in enumerate(before.halves)]
    np.testing.assert_allclose(found.gradient["add"], (pair[0].gradient["add"] + pair[1].gradient["add"]) / 2)
    fresh = [each.require("the test", FreshGradient).values["map"] for each in pair]
    np.testing.assert_allclose(found.require("the test", FreshGradient).values["map"], (fresh[0] + fresh[1]) / 2)
    assert found.loss == pytest.approx((pair[0].loss + pair[1].loss) / 2)
    assert found.info["samples"] == 2 * pair[0].info["samples"]
    assert np.abs(found.gradient["map"] - (pair[0].gradient["map"] + pair[1].gradient["map"]) / 2).max() > 0


@pytest.mark.mitsuba
def test_a_run_is_resumed_to_the_same_result(tmp_path: Path) -> None:
    asked, outer = (
        problem(loss=ur.losses.L1()),
        ur.estimators.FilteredGradient(ur.PathGradient(CV(), spp=2), {"map": (False, True)}),
    )
    assert tables.component(tables.table(outer), "estimator") == outer
    whole = ur.optimize(asked, outer, ur.optimizers.Adam(0.02), 8)
    ur.optimize(asked, outer, ur.optimizers.Adam(0.02), 5, run_directory=tmp_path / "run")
    again = ur.resume(tmp_path / "run", asked, steps=8)
    np.testing.assert_array_equal(again.parameters["map"], whole.parameters["map"])
    assert not again.warnings


def test_black_images_and_samples_that_are_no_numbers_are_passed_on() -> None:
    asked = problem(noise=0.0)
    at = dict(asked.initial(), map=TRUTHS["smooth"][..., None])
    outer = ur.estimators.FilteredGradient()
    found, _ = outer.estimate(asked, at, outer.init(asked, at), Key(0))
    np.testing.assert_allclose(found.gradient["map"], 0.0, atol=1e-9)
    broken, _ = outer.estimate(asked, dict(at, map=np.full_like(at["map"], np.nan)), outer.init(asked, at), Key(0))
    assert np.isnan(broken.gradient["map"]).all()


made: Any = ur.estimators.FilteredGradient


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: made(ur.PathGradient), "inner must be an estimator, such as PathGradient"),
        (lambda: made(3), "inner must be an estimator, such as PathGradient"),
        (
            lambda: ur.estimators.FilteredGradient(ur.estimators.LossValues()),
            "LossValues provides no gradient",
        ),
        (lambda: made(wrap=True), "wrap must be {key: true or false}, got True"),
        (lambda: made(wrap={"map": 2}), "wrap must be true, false, or one of these per axis, got 2"),
        (
            lambda: ur.estimate(problem(), ur.estimators.FilteredGradient(wrap={"mop": True})),
            'wrap: unknown parameter "mop"',
        ),
        (
            lambda: ur.estimate(problem(), ur.estimators.FilteredGradient(wrap={"map": (True,)})),
            "wrap must have 2 entries",
        ),
    ],
)
def test_bad_arguments_are_named(make: Any, message: str) -> None:
    with pytest.raises(ur.InputError) as caught:
        make()
    assert "FilteredGradient" in str(caught.value)
    assert message in str(caught.value)
