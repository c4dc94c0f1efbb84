"""`RecursiveControlVariate(max_weight=...)`: how long an image remembers."""

from __future__ import annotations

import numpy as np
import pytest

import unrender as ur
from analytic import problem
from tests.analytic import AnalyticRenderer
from unrender.core.random import Key
from unrender.images.recursive_control_variate import ViewMemory
from unrender.scene.batches import FullView
from unrender.statistics import welford

STEPS, RUNS, NOISE, SPP = 30, 12, 0.5, 2
WEIGHT = 0.8


def remembered(max_weight: float) -> tuple[np.ndarray, np.ndarray]:
    """Of the last image of an unchanging scene, in units of the variance of one step's: squared errors of its pixels in many runs, and what
    the state says of them."""
    asked = problem(noise=NOISE)
    at, renderer = asked.initial(), asked.renderer
    assert isinstance(renderer, AnalyticRenderer)
    exact = renderer.exact(at)
    of_one_step = np.square(NOISE * (exact - 0.1)) / 3 / SPP  # 0.1 has no noise, uniform noise in [-1, 1] a third
    estimator = ur.PathGradient(ur.images.RecursiveControlVariate(max_weight=max_weight), spp=SPP)
    errors, told = [], []
    for run in range(RUNS):
        state = estimator.init(asked, at)
        for step in range(STEPS):
            _, state = estimator.estimate(asked, at, state, Key(run, step))
        memory = state.image.views[0]
        errors.append(np.square(memory.image - exact) / of_one_step)
        told.append(memory.relative_variance)
    return np.array(errors), np.array(told)


def score(errors: np.ndarray) -> float:
    """Of the mean against a running mean's, (1 - w) / (1 + w)."""
    expected = (1 - WEIGHT) / (1 + WEIGHT)
    return float((errors.mean() - expected) / (errors.std(ddof=1) / np.sqrt(errors.size)))


def test_an_unchanging_scene_has_the_variance_of_a_running_mean() -> None:
    errors, told = remembered(WEIGHT)
    np.testing.assert_allclose(told, (1 - WEIGHT) / (1 + WEIGHT), rtol=1e-3)
    assert abs(score(errors)) < 4
    unbounded, _ = remembered(1.0)
    assert score(unbounded) < -4, "a bound that is ignored went unseen"


def test_weights_above_one_or_below_zero_are_refused() -> None:
    for weight in (0, 1.5, -0.1, float("nan")):
        with pytest.raises(ur.InputError, match="RecursiveControlVariate: max_weight must be"):
            ur.images.RecursiveControlVariate(max_weight=weight)


def along(move: float) -> tuple[ViewMemory, np.ndarray]:
    """After 20 steps in which the map's brightness rises by `move` of itself at each; Var[H] of the statistics."""
    asked = problem(noise=NOISE)
    image = ur.images.RecursiveControlVariate()
    state = image.init(asked, asked.initial())
    for step in range(20):
        at = {key: value * (1.0 + move) ** step for key, value in asked.initial().items()}
        _, kept = image.estimate(asked, at, state, FullView(asked, 0), SPP, 1, Key(0, step))
        state = image.advance(at, state, (kept,))
    (memory,) = state.views
    return memory, np.asarray(welford.covariance(memory.previous))


def below(memory: ViewMemory, unit: np.ndarray, relative: np.ndarray) -> float:
    """The share of pixels whose variance by `relative` is below that in absolute units."""
    return float(np.mean(relative * unit < np.asarray(memory.variance) * (1 - 1e-4)))


def test_the_variance_is_the_greater_of_two_recurrences() -> None:
    memory, unit = along(0.05)
    assert below(memory, unit, np.asarray(memory.relative_variance)) == 0
    assert np.mean(memory.relative_variance * unit > 1.001 * np.asarray(memory.variance)) > 0.1, (
        "the relative one decides nowhere"
    )
    # Relative to a variance that has been learnt to be a third of what it was: the absolute recurrence does not follow.
    assert below(memory, unit, np.asarray(memory.relative_variance) / 3) > 0.9


def test_where_nothing_moves_images_are_averaged() -> None:
    memory, _ = along(0.0)
    np.testing.assert_allclose(memory.relative_variance, 1 / 20, rtol=1e-4)
    moved, _ = along(0.05)
    assert np.abs(np.asarray(moved.relative_variance) * 20 - 1).max() > 0.01


@pytest.mark.parametrize("name", ["alpha", "beta"])
def test_a_decay_outside_its_range_is_refused(name: str) -> None:
    for decay in (-0.1, 1.0, float("nan"), "0.5"):
        with pytest.raises(
            ur.InputError, match=f"RecursiveControlVariate: {name} must be a finite number >= 0 and < 1"
        ):
            ur.images.RecursiveControlVariate(**{name: decay})  # type: ignore
