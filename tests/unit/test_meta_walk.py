"""How far MetaAdam and Adam move elements whose gradient is noise, and what they make of a small gradient in it."""

from __future__ import annotations

import numpy as np
import pytest

from unrender.core.errors import InputError
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import PastWeight, Variance
from unrender.optimizers import Adam, MetaAdam
from unrender.optimizers.base import Optimizer
from unrender.statistics import meta

ELEMENTS, STEPS, RATE = 4000, 300, 0.1
ERROR = 4.5 / np.sqrt(2 * ELEMENTS)
"""4.5 standard errors of a deviation over the elements, relative to it."""


def samples(mean: float = 0.0) -> np.ndarray:
    """(steps, elements): ±1 about a mean; their mean square is 1 + mean² at every step."""
    rng = np.random.default_rng(11)
    return rng.choice([-1.0, 1.0], (STEPS, ELEMENTS)) + mean


def moved(optimizer: Optimizer, F: np.ndarray, max_weight: float = 1.0) -> np.ndarray:
    """By how much each element moves, in learning rates; the gradient is the meta-estimate of samples that never change."""
    state, steps = meta.init(F[0]), optimizer.init({"x": F[0]}, None)
    total = np.zeros(ELEMENTS)
    for sample in F:
        gradient, variance, alpha, state = meta.update(state, sample, 0.0 * sample, 0.1, max_weight=max_weight)
        known = (Variance({"x": variance}), PastWeight({"x": alpha}))
        estimate = Estimate(0.0, {"x": sample if isinstance(optimizer, Adam) else gradient}, known)
        step, steps = optimizer.update(estimate, steps, {"x": total})
        total -= step["x"] / RATE
    return total


def wander(weights: np.ndarray) -> float:
    """The deviation of Σ w_i M_i, with M_i the mean of the first i of independent samples of variance 1."""
    of_each = np.cumsum((weights / np.arange(1, STEPS + 1))[::-1])[::-1]
    return float(np.sqrt(np.sum(of_each**2)))


def test_the_papers_rule_wanders_fourteen_times_as_far_as_adam_at_one_rate() -> None:
    count = np.arange(1, STEPS + 1)
    paper = moved(MetaAdam(RATE), samples()).std()
    assert paper == pytest.approx(wander(np.sqrt(count)), rel=ERROR)
    assert paper == pytest.approx(np.sqrt(2 / 3) * STEPS, rel=0.05)
    adam = moved(Adam(RATE), samples()).std()
    assert 13 < paper / adam < 15.5


def test_by_the_rule_of_the_walk_it_wanders_as_far_as_adam() -> None:
    count = np.arange(1, STEPS + 1)
    walk = moved(MetaAdam(RATE, rule="walk"), samples()).std()
    assert walk == pytest.approx(wander(np.sqrt(count / (2 * count - 1))), rel=ERROR)
    assert walk == pytest.approx(np.sqrt(STEPS), rel=0.1)
    assert walk / moved(Adam(RATE), samples()).std() == pytest.approx(1.0, abs=0.12)
    # A factor by the correlation's time itself, not by its root, is what the tolerances have to tell apart.
    assert wander(np.sqrt(count) / (2 * count - 1)) < 0.5 * walk


@pytest.mark.parametrize("weight", [0.5, 0.9])
def test_a_memory_of_one_length_makes_no_difference_to_the_walk(weight: float) -> None:
    walk = moved(MetaAdam(RATE, rule="walk"), samples(), max_weight=weight).std()
    assert walk == pytest.approx(np.sqrt(STEPS), rel=0.12)
    correlated = np.sqrt(STEPS * (1 + weight) / (1 - weight))
    assert moved(MetaAdam(RATE), samples(), max_weight=weight).std() == pytest.approx(correlated, rel=0.12)


def test_no_rule_makes_more_of_a_small_gradient_in_noise_than_adam() -> None:
    """What a mean of 0.05 moves elements by, over what noise does."""
    F, ratio = samples(0.05), {}
    for name, optimizer in {
        "adam": Adam(RATE), "deviation": MetaAdam(RATE), "walk": MetaAdam(RATE, rule="walk")
    }.items():  # fmt: skip
        total = moved(optimizer, F)
        ratio[name] = -total.mean() / total.std() if total.mean() < 0 else total.mean() / total.std()
    best = 0.05 * np.sqrt(STEPS)
    assert ratio["adam"] == pytest.approx(best, rel=0.1)
    # (2/3) n^1.5 over √(2/3) n, and n / √2 over √n
    assert ratio["deviation"] == pytest.approx(best * np.sqrt(2 / 3), rel=0.1)
    assert ratio["walk"] == pytest.approx(best * np.sqrt(1 / 2), rel=0.1)


def test_the_walk_requires_the_weight_of_the_past() -> None:
    assert MetaAdam().requires == {"gradient", "variance"}
    optimizer = MetaAdam(rule="walk")
    assert optimizer.requires == {"gradient", "variance", "past_weight"}
    gradient = {"x": np.ones(3)}
    with pytest.raises(InputError, match="past_weight"):
        optimizer.update(Estimate(0.0, gradient, (Variance(gradient),)), optimizer.init(gradient, None), gradient)
    with pytest.raises(InputError, match="MetaAdam: rule must be one of deviation, walk"):
        MetaAdam(rule="other")  # pyright: ignore[reportArgumentType]
