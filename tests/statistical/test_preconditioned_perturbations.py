"""Smoothed derivatives of a texture with a preconditioner: by the coordinates of the descent, against closed forms.

Images are linear in the texture and without noise, so the loss is a quadratic with Hessian H, whose smoothed derivatives are its own: with
S as a dense matrix, S ∇L and S H S.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import slow
from unrender.estimators.base import Estimate
from unrender.estimators.coordinates import by_coordinates
from unrender.estimators.penalties import penalized

SIDE = 6
N = SIDE * SIDE
SIGMA = 0.1
SMOOTH = ur.preconditioners.LargeSteps(4.0)
LIMIT = 4.5
"""Of the greatest of 36 scores of 100 runs: exceeded by chance once in 1500 tests."""


class Case:
    """A ramp of 36 texels in 16 pixels, with the exact derivatives of its loss."""

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        ramp = np.linspace(0.2, 0.8, SIDE)[:, None, None] * np.ones((SIDE, SIDE, 1))
        self.renderer = AnalyticRenderer({"x": ramp}, rng.standard_normal((48, N)), noise=0.0)
        self.problem = self.made(preconditioner=SMOOTH)
        S = np.stack([SMOOTH.apply(e.reshape(SIDE, SIDE, 1)).ravel() for e in np.eye(N, dtype=np.float32)])
        plain = self.made()

        def gradient(x: np.ndarray) -> np.ndarray:
            found = ur.estimate(plain, ur.PathGradient(), {"x": x.reshape(SIDE, SIDE, 1)})
            return found.gradient["x"].ravel().astype(float)

        start = np.full(N, 0.5)
        at = gradient(start)
        self.S, self.gradient = S, S @ at
        self.hessian = S @ np.stack([(gradient(start + 0.1 * e) - at) / 0.1 for e in np.eye(N)]) @ S

    def made(self, **more: Any) -> ur.Problem:
        view = ur.View(self.renderer.exact({}))
        return ur.Problem(self.renderer, [ur.Parameter("x", initial=0.5, **more)], [view])


@pytest.fixture(scope="module")
def case() -> Case:
    return Case()


def estimates(case: Case, count: int, **options: Any) -> list[Estimate]:
    estimator = ur.SmoothedDerivatives(SIGMA, 64, **options)
    return [ur.estimate(case.problem, estimator, seed=seed) for seed in range(count)]


def worst(found: np.ndarray, exact: np.ndarray) -> float:
    """The greatest magnitude of z-scores of the means of independent estimates (runs, ...)."""
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    return float(np.abs((found.mean(axis=0) - exact) / error).max())


@pytest.mark.parametrize(
    "options",
    [{}, slow({"aggregate": False}), slow({"order": "hvp"}), slow({"order": "hessian"}), {"orthogonal": True}],
    ids=str,
)
def test_gradients_are_by_the_coordinates_of_the_descent(case: Case, options: dict[str, Any]) -> None:
    found = np.stack([e.gradient["x"].ravel() for e in estimates(case, 100, **options)]).astype(float)
    assert worst(found, case.gradient) < LIMIT
    assert worst(found, np.linalg.solve(case.S, case.gradient)) > 3 * LIMIT  # by the texture itself


def test_the_loop_does_not_apply_the_preconditioner_again(case: Case) -> None:
    (found,) = estimates(case, 1)
    assert found.preconditioned
    again = by_coordinates(found, case.problem, case.problem.initial())
    np.testing.assert_array_equal(again.gradient["x"], found.gradient["x"])


@pytest.mark.parametrize("joint", [True, slow(False)])
def test_products_are_by_the_coordinates_of_the_descent(case: Case, joint: bool) -> None:
    v = np.random.default_rng(2).standard_normal(N)
    along = {"x": v.reshape(SIDE, SIDE, 1).astype(np.float32)}

    def product(found: Estimate) -> np.ndarray:
        assert found.hvp is not None
        return np.asarray(found.hvp(along)["x"], float).ravel()

    found = np.stack([product(e) for e in estimates(case, 100, order="hvp", joint=joint)])
    assert worst(found, case.hessian @ v) < LIMIT
    unsmoothed = np.linalg.solve(case.S, np.linalg.solve(case.S, case.hessian).T) @ v
    assert worst(found, unsmoothed) > 3 * LIMIT


def test_losses_are_along_steps_of_the_descent(case: Case) -> None:
    """A step of v moves the texture by S times it, also where an optimizer asks for the loss there."""
    (found,) = estimates(case, 1)
    step = np.random.default_rng(3).standard_normal(N) * 0.1
    assert found.losses is not None
    start = np.full(N, 0.5)
    ahead, there = found.losses(np.stack([start + step, start]))
    plain = ur.estimate(case.made(), ur.SmoothedDerivatives(SIGMA, 64))
    assert plain.losses is not None
    np.testing.assert_allclose([ahead, there], plain.losses(np.stack([start + case.S @ step, start])), rtol=1e-4)
    assert abs(ahead - plain.losses((start + step)[None])[0]) > 1e-2 * ahead


def test_perturbed_elements_move_by_sigma_in_the_mean_square(case: Case) -> None:
    (found,) = estimates(case, 1)
    assert found.sigma is not None
    expected = SIGMA / np.sqrt(np.trace(case.S @ case.S) / N)
    # Four draws of 36 texels, of which some ten are independent.
    assert found.sigma["x"] == pytest.approx(expected, rel=0.25)
    assert found.sigma["x"] > 1.5 * SIGMA


@pytest.mark.slow
def test_newtons_steps_recover_the_smooth_part(case: Case) -> None:
    """Descent along smooth perturbations, products and a line search among them: the images are met."""
    estimator = ur.SmoothedDerivatives(SIGMA, 256, order="hvp", spp=1)
    optimizer = ur.optimizers.NewtonCG(trust_radius=6.0, iterations=4, line=True)
    result = ur.optimize(case.problem, estimator, optimizer, steps=40)
    assert result.history[-1]["loss"] < 0.05 * result.history[0]["loss"]


def test_priors_are_by_the_coordinates_of_the_descent(case: Case) -> None:
    """The prior of a texture S v, as products and losses of an estimate by v add it."""
    problem = case.made(preconditioner=SMOOTH, prior={"near": 0.2, "std": 0.1})
    start, v = np.full(N, 0.5), np.random.default_rng(3).standard_normal(N)
    found = ur.estimate(problem, ur.SmoothedDerivatives(SIGMA, 64, order="hvp"))
    total = penalized(found, problem, problem.initial())
    assert found.hvp is not None
    assert found.losses is not None
    assert total.hvp is not None
    assert total.losses is not None
    along = {"x": v.reshape(SIDE, SIDE, 1).astype(np.float32)}
    product = np.ravel(total.hvp(along)["x"]) - np.ravel(found.hvp(along)["x"])
    scale = problem.prior_scales["x"] / 0.1**2
    np.testing.assert_allclose(product, scale * case.S @ (case.S @ v), rtol=1e-3, atol=1e-3 * scale)
    points = np.stack([start, start + 0.1 * v])
    values = [0.5 * scale * np.sum((start + 0.1 * t * case.S @ v - 0.2) ** 2) for t in (0.0, 1.0)]
    np.testing.assert_allclose(total.losses(points) - found.losses(points), values, rtol=1e-4)
