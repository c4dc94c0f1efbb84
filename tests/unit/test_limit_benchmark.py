"""The benchmark of the limit, against the closed form of pictures that are linear in the unknowns with Gaussian noise."""

from __future__ import annotations

import numpy as np
import pytest

import unrender as ur
from benchmarks.limit import run as limit
from tests.analytic import AnalyticRenderer

SHAPE, NOISE = (6, 6), 0.3
MATRIX = np.random.default_rng(0).normal(0.0, 1.0, (SHAPE[0] * SHAPE[1] * 3, 3))
TRUTH = {"a": np.array([0.6, 0.3]), "b": np.array(0.5)}


@pytest.fixture
def problem() -> ur.Problem:
    """Return three numbers, whose picture has independent noise of one size in all channels."""
    renderer = AnalyticRenderer(TRUTH, MATRIX, offset=2.0, noise=0.0, grain=NOISE * np.sqrt(3.0), shape=SHAPE)
    parameters = [ur.Parameter(key, initial=0.5 * value) for key, value in TRUTH.items()]
    return ur.Problem(renderer, parameters, [ur.View(renderer.exact(TRUTH).astype(np.float32))], truth=TRUTH)


def test_the_information_is_that_of_the_closed_form(problem: ur.Problem) -> None:
    """Within 4 %: 108 pixels and channels, each variance from 256 pictures. Of eight pictures, the inverse is off without its factor."""
    found, most, rows = limit.information(problem, 1 << 16)
    exact = MATRIX.T @ MATRIX / NOISE**2
    np.testing.assert_allclose(np.diag(found), np.diag(exact), rtol=0.04)
    assert (np.diag(most) > 0.95 * np.diag(exact)).all()
    assert rows == {"a": slice(0, 2), "b": slice(2, 3)}
    noise = np.random.default_rng(1).normal(0.0, NOISE, (8, 4000, 3))
    inverse = np.diagonal(limit.inverse_covariance(noise), axis1=1, axis2=2).mean() * NOISE**2
    assert inverse == pytest.approx(1.0, abs=0.05)
    assert inverse * 7 / 3 > 1.5  # planted: without the factor of eight pictures


def test_least_squares_reaches_the_limit_and_nothing_is_below(problem: ur.Problem) -> None:
    """400 fits to pictures of one path: their error is the limit, in the prior's absence. The prior only matters for few paths."""
    exact = MATRIX.T @ MATRIX / NOISE**2
    rows = {"a": slice(0, 2), "b": slice(2, 3)}
    paths = np.array([1e-9, 1.0])
    start, end = limit.limit(problem, exact, rows, paths)
    assert start == pytest.approx(1.0, rel=1e-6)
    noise = np.random.default_rng(2).normal(0.0, NOISE, (400, len(MATRIX)))
    misses = noise @ np.linalg.pinv(MATRIX).T
    squares = [np.mean(np.square(misses[:, of])) / np.mean(np.square(0.5 * TRUTH[key])) for key, of in rows.items()]
    assert end == pytest.approx(float(np.mean(np.sqrt(squares))), rel=0.08)
