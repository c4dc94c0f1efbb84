"""Weights, variances and recursion put together as an image estimator does, on Gaussian 'scenes' with known answers.

A scene is many independent pixels of mean `MEAN` and standard deviation `SPREAD`. F and H are its current and previous
image, correlated by `correlation`; 1 is a scene that does not change. Expected are the variance of the control variate
across pixels, measured with its standard error, and the weight.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tiers import quick
from unrender import statistics
from unrender.statistics import welford
from unrender.statistics.recursion import advance

PIXELS, MEAN, SPREAD = 20_000, 3.0, 0.7
STEPS = 40
BLIND = 2
"""Steps before the statistics hold two samples: until then the weight is 0 and the latest image stands alone."""

FAULTS = ("wrong lag", "variance of the control variate ignored", "twice the covariance", "last term of Eq. 10 missing")


def descend(correlation: float, fault: str | None = None, warm_up: int = 0, seed: int = 11):
    """Run the recursion; per step the mean weight, the predicted and the measured variance over SPREAD².

    The variance of the control variate is kept in units of one image's, which Eq. 10 leaves as it is. The recursion
    starts after `warm_up` steps that feed only the statistics.
    """
    random = np.random.default_rng(seed)
    current = previous = joint = welford.init(np.zeros(PIXELS))
    memory, relative, last_H = np.zeros(PIXELS), np.ones(PIXELS), np.zeros(PIXELS)
    weights, predicted, measured = [], [], []
    for n in range(-warm_up, STEPS):
        z, independent = random.normal(size=(2, PIXELS))
        F = MEAN + SPREAD * z
        H = MEAN + SPREAD * (correlation * z + np.sqrt(1.0 - correlation**2) * independent)
        if n > 0:
            var_previous = welford.covariance(previous)
            var_cv = 0.0 if fault == "variance of the control variate ignored" else relative * var_previous
            w = statistics.control_weight(welford.covariance(joint), var_previous, var_cv)
            memory = advance(memory, F, H, w)
        elif n == 0:
            w, memory = np.zeros(PIXELS), F
        if n != 0:  # the first image is Eq. 7's, a control variate and no pair
            current, previous = welford.update(current, F, F), welford.update(previous, H, H)
            joint = welford.update(joint, F, last_H if fault == "wrong lag" else H)
            last_H = H
        if n > 0:
            var_current, var_previous = welford.covariance(current), welford.covariance(previous)
            cov = welford.covariance(joint) * (2.0 if fault == "twice the covariance" else 1.0)
            var_cv = relative * (0.0 if fault == "last term of Eq. 10 missing" else var_previous)
            variance = statistics.control_variate_variance(w, var_current, var_previous, cov, var_cv)
            relative = np.divide(variance, var_current, out=np.ones(PIXELS), where=var_current > 0)
        if n >= 0:
            weights.append(w.mean())
            predicted.append(relative.mean())
            measured.append(memory.var() / SPREAD**2)
        if n == STEPS - 1:
            # Unbiased, to its own standard error: a check of all that follows.
            assert abs(memory.mean() - MEAN) < 5 * memory.std() / np.sqrt(PIXELS)
    return np.array(weights), np.array(predicted), np.array(measured)


def worst_z(measured: np.ndarray, expected: np.ndarray) -> float:
    """Largest standard score of measured variances of Gaussian pixels (relative standard error √(2/PIXELS))."""
    return float(np.abs((measured / expected - 1.0) / np.sqrt(2.0 / PIXELS)).max())


def limit(count: int, level: float = 1e-3) -> float:
    """The score that the worst of `count` exceeds with probability `level`, after Šidák."""
    return float(stats.norm.isf((1.0 - (1.0 - level) ** (1.0 / count)) / 2.0))


def unchanging_scene_as_expected(fault: str | None) -> bool:
    """Whether weight n/(n+1) and variance 1/(n+1) are found, n counted from the first step that has statistics."""
    weights, predicted, measured = descend(1.0, fault)
    n = np.maximum(np.arange(STEPS) - BLIND, 0)
    return (
        np.allclose(weights, n / (n + 1.0), atol=1e-9)
        and np.allclose(predicted, 1.0 / (n + 1.0), rtol=1e-9)
        and worst_z(measured, 1.0 / (n + 1.0)) < limit(STEPS)
    )


def test_unchanging_scene():
    assert unchanging_scene_as_expected(None)


@pytest.mark.parametrize("fault", FAULTS)
def test_unchanging_scene_tells_faults(fault):
    assert not unchanging_scene_as_expected(fault)


def steady_state_as_expected(correlation: float, fault: str | None) -> bool:
    """Whether weights and recursion settle where Eqs 8 and 10 do: r = 1 − ρ²/(1 + r), so r = √(1 − ρ²), w = ρ/(1 + r).

    Weights from estimated statistics are noisy, which costs second-order variance: 2 % is granted.
    """
    weights, predicted, measured = (series[-10:] for series in descend(correlation, fault, warm_up=300))
    r = np.sqrt(1.0 - correlation**2)
    granted = 0.02
    return (
        np.allclose(weights, correlation / (1.0 + r), rtol=granted)
        and np.allclose(predicted, r, rtol=granted)
        and bool(np.all(np.abs(measured / r - 1.0) < granted + limit(10) * np.sqrt(2.0 / PIXELS)))
    )


@pytest.mark.parametrize("correlation", quick([0.99, 0.9, 0.6], 0.9))
def test_changing_scene(correlation):
    assert steady_state_as_expected(correlation, None)


@pytest.mark.parametrize("fault", quick(FAULTS, "wrong lag", "last term of Eq. 10 missing"))
def test_changing_scene_tells_faults(fault):
    assert not steady_state_as_expected(0.9, fault)


def test_absolute_variance_from_warm_statistics():
    """The paper's own form of the recurrence, in absolute variances (Fig. 3, bottom), once the statistics have settled.

    Their relative variance v is measured; the weight's deviation from n/(n+1) is of that order, not of order √v.
    """
    random, steps = np.random.default_rng(12), 40
    state = welford.init(np.zeros(PIXELS))
    for _ in range(400):
        F = SPREAD * random.normal(size=PIXELS)
        state = welford.update(state, F, F)
    estimated = welford.covariance(state)
    spread = estimated.var() / SPREAD**4
    assert 1e-3 < spread < 2e-2
    memory, var_cv = SPREAD * random.normal(size=PIXELS), estimated
    for n in range(1, steps):
        F = SPREAD * random.normal(size=PIXELS)
        w = statistics.control_weight(welford.covariance(state), welford.covariance(state), var_cv)
        memory = advance(memory, F, F, w)
        state = welford.update(state, F, F)
        known = welford.covariance(state)
        var_cv = statistics.control_variate_variance(w, known, known, known, var_cv)
        assert w.mean() == pytest.approx(n / (n + 1), rel=2 * spread)
        assert memory.var() / SPREAD**2 == pytest.approx(1 / (n + 1), rel=2 * spread + 4 * np.sqrt(2 / PIXELS))
