"""Every estimator in a spectral variant: its gradient is right, or it is refused by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats
from test_estimators import ESTIMATORS

import unrender as ur
from spectral_scenes import DEPTH, KEYS, SIZE, scene
from tiers import quick
from unrender.rendering.mitsuba import film_response

pytestmark = pytest.mark.usefixtures("spectral_variant")

COUNT = 24
OTHER_EXPECTATION = {name for name in ESTIMATORS if name.startswith(("smoothed", "loss values")) or "denoised" in name}
"""Gradients of smoothed losses and of denoised images, which differ from that of the loss."""
REFUSED: dict[str, str] = {}
"""{estimator: pattern of the message}."""


@pytest.fixture(scope="module")
def problem(spectral_variant: str) -> ur.Problem:
    reference = np.random.default_rng(1).uniform(0.05, 0.5, (SIZE, SIZE, 3)).astype(np.float32)
    return ur.Problem(scene(), [ur.Parameter(key) for key in KEYS], [ur.View(reference)], max_depth=DEPTH)


def rows(problem: ur.Problem, estimator: Any, count: int, seed: int = 0) -> np.ndarray:
    """(count, n): independent estimates from a fresh state, each along fixed directions of the parameters."""
    found = []
    for number in range(count):
        gradient = ur.estimate(problem, estimator, seed=seed + number).gradient
        parts = []
        for key in KEYS:
            values = gradient[key].reshape(-1)
            directions = np.random.default_rng(len(values)).uniform(0.5, 1.5, (4, len(values)))
            parts.append(values if len(values) <= 4 else directions @ values)
        found.append(np.concatenate(parts))
    return np.stack(found).astype(float)


@pytest.fixture(scope="module")
def expected(problem: ur.Problem) -> np.ndarray:
    return rows(problem, ur.PathGradient(spp=128), 12, seed=1000)


def worst(found: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """The largest |z| of two means, and its limit at 1e-3 after Šidák."""
    error = np.sqrt(found.var(0, ddof=1) / len(found) + expected.var(0, ddof=1) / len(expected))
    z = (found.mean(0) - expected.mean(0)) / error
    limit = stats.t.isf((1 - (1 - 1e-3) ** (1 / z.size)) / 2, len(found) - 1)
    return float(np.abs(z).max()), float(limit)


@pytest.mark.parametrize("name", quick(ESTIMATORS, "control variate, path space"))
def test_the_gradient_is_right_or_refused(name: str, problem: ur.Problem, expected: np.ndarray) -> None:
    estimator = ESTIMATORS[name]()
    if name in REFUSED:
        with pytest.raises(ur.InputError, match=REFUSED[name]):
            ur.estimate(problem, estimator)
        return
    if "gradient" not in estimator.provides or name in OTHER_EXPECTATION:
        assert np.isfinite(ur.estimate(problem, estimator).loss)
        return
    found = rows(problem, estimator, COUNT)
    z, limit = worst(found, expected)
    assert z < limit, f"{name}: |z| {z:.2f}, limit {limit:.2f}"


@pytest.mark.slow
def test_a_wrong_weight_of_the_wavelengths_is_found_out(
    problem: ur.Problem, expected: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The planted fault: the adjoint takes the wavelengths as uniform. A new problem records its kernels with it."""
    right = film_response.FilmResponse.pull_back
    monkeypatch.setattr(film_response.FilmResponse, "pull_back", lambda self, δ: right(self, δ) / self.weight * 470.0)
    views = [ur.View(problem.reference(0))]
    faulty = ur.Problem(scene(), [ur.Parameter(key) for key in KEYS], views, max_depth=DEPTH)
    z, limit = worst(rows(faulty, ur.PathGradient(spp=32), COUNT), expected)
    assert z > limit
