"""How far MetaAdam and Adam move elements whose gradient is noise, and what they make of a small gradient in it."""

from __future__ import annotations

import numpy as np
import pytest

from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Variance
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
        gradient, variance, _, state = meta.update(state, sample, 0.0 * sample, 0.1, max_weight=max_weight)
        own = {"x": sample if isinstance(optimizer, Adam) else gradient}
        estimate = Estimate(0.0, own, (Variance({"x": variance}),))
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


@pytest.mark.parametrize("weight", [0.5, 0.9])
def test_a_memory_of_one_length_correlates_the_steps(weight: float) -> None:
    correlated = np.sqrt(STEPS * (1 + weight) / (1 - weight))
    assert moved(MetaAdam(RATE), samples(), max_weight=weight).std() == pytest.approx(correlated, rel=0.12)


def test_the_papers_rule_makes_no_more_of_a_small_gradient_in_noise_than_adam() -> None:
    """What a mean of 0.05 moves elements by, over what noise does."""
    F, ratio = samples(0.05), {}
    for name, optimizer in {"adam": Adam(RATE), "deviation": MetaAdam(RATE)}.items():
        total = moved(optimizer, F)
        ratio[name] = -total.mean() / total.std() if total.mean() < 0 else total.mean() / total.std()
    best = 0.05 * np.sqrt(STEPS)
    assert ratio["adam"] == pytest.approx(best, rel=0.1)
    # (2/3) n^1.5 over √(2/3) n
    assert ratio["deviation"] == pytest.approx(best * np.sqrt(2 / 3), rel=0.1)
