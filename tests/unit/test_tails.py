"""The benchmark of heavy tails: clipping whose rest comes later has no bias in the long run, and the figures are what they say."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.adaptive.tails.prototypes import cut, share
from benchmarks.adaptive.tails.run import judged

STEPS, CHAINS = 400, 200


def clipped(values: np.ndarray, limit: float, release: float) -> np.ndarray:
    """Chains (chains, steps) of clipped values with what a step gets of the store."""
    store, found = np.zeros(len(values)), []
    for now in values.T:
        inside, rest = cut(now, limit)
        got, store = share(store, rest, release)
        found.append(inside + got)
    return np.stack(found, axis=1)


@pytest.mark.parametrize("release", [0.125, 0.5])
def test_what_is_cut_off_comes_later(release: float) -> None:
    values = np.exp(1.5 * np.random.default_rng(3).standard_normal((CHAINS, STEPS)))
    settled = clipped(values, 3.0, release)[:, 50:].mean(axis=1)
    error = settled.std(ddof=1) / np.sqrt(CHAINS)
    assert abs(settled.mean() - np.exp(1.125)) < 4 * error
    dropped = clipped(values, 3.0, 0.0)[:, 50:].mean()
    assert abs(dropped - np.exp(1.125)) > 20 * error  # the fault that it must catch


def test_clipping_lowers_the_variance_of_a_step_not_that_of_the_mean() -> None:
    values = np.exp(1.5 * np.random.default_rng(4).standard_normal((CHAINS, STEPS)))
    now, before = clipped(values, 3.0, 0.125)[:, 50:], values[:, 50:]
    assert now.var() < before.var() / 3
    assert now.mean(axis=1).var() > before.mean(axis=1).var() / 1.5


def test_variances_and_distances_are_those_of_known_gradients() -> None:
    random = np.random.default_rng(5)
    rows, own = random.standard_normal((2, 64, 30, 4)) * np.array([1.0, 2.0, 3.0, 0.0])
    weights = np.array([1.0, 0.25, 1.0, 5.0])
    found = judged(rows, own, weights)
    assert abs(found["step"][0] - 11.0) < 4 * found["step"][1]
    assert found["step"][1] < 0.5
    assert abs(found["mean"] - 11.0) < 4 * 11.0 * np.sqrt(2 / 64)
    assert found["distance"] < 4
    assert judged(rows + np.array([1.0, 0, 0, 0]), own, weights)["distance"] > 40
    carried = np.repeat(rows[:, :1], 30, axis=1)  # chains whose steps are all alike
    assert judged(carried, own, weights)["mean"] > 20 * found["mean"]
