"""Means of correlated sequences, and their standard errors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from unrender.runs import number_means

RUNS, STEPS = 400, 300


def wandering(correlation: float, seed: int = 0, steps: int = STEPS) -> np.ndarray:
    """Return autoregressive sequences (RUNS, steps) of variance 1 around 0, and their exact correlation time."""
    generator = np.random.default_rng(seed)
    values = np.empty((RUNS, steps))
    values[:, 0] = generator.standard_normal(RUNS)
    for step in range(1, steps):
        news = generator.standard_normal(RUNS)
        values[:, step] = correlation * values[:, step - 1] + np.sqrt(1 - correlation**2) * news
    return values


def oscillating(period: float = 60.0, decay: float = 30.0, seed: int = 0) -> np.ndarray:
    """Return sequences like `wandering` of order 2, as steps with momentum give."""
    generator = np.random.default_rng(seed)
    shrink = np.exp(-1.0 / decay)
    values = np.zeros((RUNS, 2 * STEPS))
    news = generator.standard_normal(values.shape)
    for step in range(2, 2 * STEPS):
        values[:, step] = 2.0 * shrink * np.cos(2.0 * np.pi / period) * values[:, step - 1] + news[:, step]
        values[:, step] -= shrink**2 * values[:, step - 2]
    return values[:, STEPS:] / values.std()


@pytest.mark.parametrize(
    "paths",
    [lambda: wandering(0.0), lambda: wandering(0.5), lambda: wandering(0.9), oscillating],
    ids=[0, 0.5, 0.9, "waves"],
)
def test_standard_errors_of_a_mean_cover_it(paths: Callable[[], np.ndarray]) -> None:
    """Of 400 sequences, some 68 % are within one standard error. 8 % are 3.4 standard deviations of that number."""
    found = [mean for x in paths() if (mean := number_means.stationary_mean(x)) is not None]
    assert len(found) > 0.95 * RUNS
    inside = np.mean([abs(mean.value) < mean.error for mean in found])
    assert inside == pytest.approx(0.68, abs=0.08)


def test_errors_of_independent_values_would_not_cover_it() -> None:
    """The planted fault: correlated values that are taken for independent ones."""
    inside = np.mean([abs(x.mean()) < x.std() / np.sqrt(len(x)) for x in wandering(0.9)])
    assert inside < 0.35


def test_the_window_leaves_out_the_way_to_the_mean() -> None:
    """A start 30 standard deviations away, which decays within some 20 steps."""
    paths = wandering(0.8, 1) + 30.0 * np.exp(-np.arange(STEPS) / 8.0)
    found = [number_means.stationary_mean(x) for x in paths]
    assert np.mean([mean is not None for mean in found]) > 0.9
    means = np.array([mean.value for mean in found if mean is not None])
    ends = paths[:, -1]
    assert np.sqrt(np.mean(means**2)) < 0.4 * np.sqrt(np.mean(ends**2))
    assert all(15 <= mean.start <= STEPS // 2 for mean in found if mean is not None)


@pytest.mark.parametrize(
    "path",
    [
        np.exp(-np.arange(STEPS) / 100.0),
        np.exp(-np.arange(STEPS) / 5.0),
        np.linspace(1.0, 0.0, STEPS),
        np.ones(STEPS),
        np.zeros(8),
    ],
    ids=["slow", "fast", "straight", "constant", "short"],
)
def test_a_path_without_noise_has_no_mean(path: np.ndarray) -> None:
    assert number_means.stationary_mean(path) is None


def test_a_drift_beyond_the_noise_has_no_mean() -> None:
    found = [number_means.stationary_mean(x + 0.05 * np.arange(STEPS)) for x in wandering(0.5, 2)]
    assert np.mean([mean is None for mean in found]) > 0.98


def test_the_long_run_variance_of_an_autoregressive_sequence() -> None:
    """(1 + ρ) / (1 − ρ) times its variance."""
    found = np.array([number_means.long_run_variance(x) for x in wandering(0.6, 3, 2000)])
    spread = found.std(axis=0) / np.sqrt(RUNS)
    assert found[:, 0].mean() == pytest.approx(4.0, abs=4 * spread[0] + 0.1)
    assert found[:, 1].mean() == pytest.approx(4.0, abs=4 * spread[1] + 0.1)
