"""Every estimator in a spectral variant: its gradient is right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats
from test_estimators import ESTIMATORS as OF_ANALYTIC_PROBLEMS

import unrender as ur
from spectral_scenes import COLOUR, DEPTH, SIZE, SPECTRUM, TEXTURE, scene
from unrender.rendering.mitsuba import film_response

pytestmark = pytest.mark.usefixtures("spectral_variant")

COUNT, COUNT_OF_DEAR = 20, 4
NAMES = {"map": TEXTURE, "colour": COLOUR, "spectrum": SPECTRUM}
ESTIMATORS = {
    **OF_ANALYTIC_PROBLEMS,
    "adaptive emitters": lambda: ur.PathGradient(spp=2, emitters="adaptive"),
}
DEAR = ("Gauss-Newton",)
"""Estimators with a rendering per element."""
OTHER_EXPECTATION = {name for name in ESTIMATORS if name.startswith(("smoothed", "loss values")) or "denoised" in name}
"""Gradients of smoothed losses and of denoised images, which differ from that of the loss."""


def made() -> ur.Problem:
    reference = np.random.default_rng(1).uniform(0.05, 0.5, (SIZE, SIZE, 3)).astype(np.float32)
    parameters = [ur.Parameter(name, keys=(key,)) for name, key in NAMES.items()]
    return ur.Problem(scene(), parameters, [ur.View(reference)], max_depth=DEPTH)


@pytest.fixture(scope="module")
def problem(spectral_variant: str) -> ur.Problem:
    return made()


def rows(problem: ur.Problem, estimator: Any, count: int, seed: int = 0) -> np.ndarray:
    """(count, n): independent estimates from a fresh state, each along fixed directions of the parameters."""
    found = []
    for number in range(count):
        gradient = ur.estimate(problem, estimator, seed=seed + number).gradient
        parts = []
        for key in NAMES:
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


@pytest.mark.slow  # tests/render/test_spectral.py has the adjoint in the quick tier
@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_gradient_is_right(name: str, problem: ur.Problem, expected: np.ndarray) -> None:
    estimator = ESTIMATORS[name]()
    if "gradient" not in estimator.provides or name in OTHER_EXPECTATION:
        assert np.isfinite(ur.estimate(problem, estimator).loss)
        return
    found = rows(problem, estimator, COUNT_OF_DEAR if name in DEAR else COUNT)
    z, limit = worst(found, expected)
    assert z < limit, f"{name}: |z| {z:.2f}, limit {limit:.2f}"


@pytest.mark.slow
def test_a_wrong_weight_of_the_wavelengths_is_found_out(expected: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """The planted fault: the adjoint takes the wavelengths as uniform. A new problem records its kernels with it."""
    right = film_response.FilmResponse.pull_back
    monkeypatch.setattr(film_response.FilmResponse, "pull_back", lambda self, δ: right(self, δ) / self.weight * 470.0)
    z, limit = worst(rows(made(), ur.PathGradient(spp=32), COUNT), expected)
    assert z > limit
