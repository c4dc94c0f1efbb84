"""Sobolev: applied twice it is LargeSteps, and its strength follows the texture's size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import quick, slow
from unrender.core.errors import InputError
from unrender.preconditioners import LargeSteps, Sobolev
from unrender.runs import loop
from unrender.runs.run import GradientNoise


def data(shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(3).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize("shape", [(7, 5, 3), (1, 9, 1), (4, 5, 6, 2)])
def test_its_square_is_large_steps(shape: tuple[int, ...], wrap: bool):
    x, smooth = data(shape), Sobolev(12.0, wrap)
    np.testing.assert_allclose(smooth.apply(smooth.apply(x)), LargeSteps(12.0, wrap).apply(x), atol=3e-6)


def test_constants_pass_and_a_checkerboard_is_damped_by_the_root():
    np.testing.assert_allclose(Sobolev(50.0).apply(np.full((6, 8, 1), 2.0, np.float32)), 2.0, rtol=1e-6)
    board = np.indices((8, 8)).sum(0)[..., None] % 2 * 2.0 - 1.0
    found = Sobolev(10.0, True).apply(board.astype(np.float32))
    np.testing.assert_allclose(found, board / np.sqrt(1 + 8 * 10.0), rtol=1e-5)


def test_the_strength_grows_with_the_texture():
    x = data((32, 8, 3))
    np.testing.assert_array_equal(Sobolev().apply(x), Sobolev((16 / 8) ** 2).apply(x))


@pytest.mark.parametrize("options", [{"strength": -1.0}, {"strength": float("inf")}, {"wrap": 1}, {"wrap": ()}])
def test_refuses_options(options: dict):
    with pytest.raises(InputError, match="Sobolev"):
        Sobolev(**options)


def test_refuses_what_is_no_texture():
    with pytest.raises(InputError, match="Sobolev needs a texture"):
        Sobolev().check("key", (3,))
    with pytest.raises(InputError, match="must have 3 entries"):
        Sobolev(1.0, (True, False)).check("key", (2, 3, 4, 1))


SATURATED = np.full((12, 12, 1), 0.5)
SATURATED[3:7, 3:7] = 1.6
ESTIMATORS: dict[str, Callable[[], Any]] = {
    "path": lambda: ur.PathGradient(spp=2),
    "meta": ur.MetaEstimator,
    "coupled": lambda: ur.MetaEstimator(coupled=True),
    "smoothed": lambda: ur.SmoothedDerivatives(0.05, samples=64),
    "hybrid": lambda: ur.estimators.HybridGradient(perturbed=ur.SmoothedDerivatives(0.01, samples=16), keys=("other",)),
    "hybrid, coupled": lambda: ur.estimators.HybridGradient(
        ur.MetaEstimator(coupled=True), ur.SmoothedDerivatives(0.01, samples=16), keys=("other",)
    ),
}


@pytest.mark.parametrize("known", [True, slow(False)])
@pytest.mark.parametrize("name", quick(ESTIMATORS, "path", "hybrid"))
def test_texels_beside_saturated_ones_are_not_led_astray(
    name: str, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A square of 1.6 where 1 is the bound. The planted fault spreads its gradient over its neighbours."""
    if not known:
        monkeypatch.setattr(loop, "free_of_bounds", lambda *_: {})
    keys: tuple[str, ...] = ("map", "other") if name.startswith("hybrid") else ("map",)
    values: dict[str, Any] = dict.fromkeys(keys, SATURATED)
    matrix = np.repeat(np.eye(144 * len(keys)), 3, axis=0)
    renderer = AnalyticRenderer(values, matrix, noise=0.0, shape=(12 * len(keys), 12))
    unknowns = [ur.Parameter(key, 0.4, (0, 1), preconditioner=Sobolev(4.0)) for key in keys]
    problem = ur.Problem(renderer, unknowns, [ur.View(renderer.exact(values))])
    result = ur.optimize(
        problem, ESTIMATORS[name](), ur.optimizers.Adam(0.02), steps=300 if name == "smoothed" else 200
    )
    error = float(np.abs(result.last["map"] - np.minimum(SATURATED, 1.0)).max())
    assert error < (0.08 if name == "smoothed" else 0.03) if known else error > 0.2


@pytest.mark.parametrize(("name", "most"), [("path", 0.002), ("coupled", 0.01), slow("smoothed", 0.003)])
def test_noise_does_not_move_texels_from_their_bounds(name: str, most: float) -> None:
    """Where the minimum is at the bound: if the present gradient held elements, only its inward noise would pass."""
    wanted = np.ones((12, 12, 1))
    renderer = AnalyticRenderer({"map": wanted}, np.repeat(np.eye(144), 3, axis=0), grain=1.0, shape=(12, 12))
    unknown = ur.Parameter("map", 0.9, (0, 1), preconditioner=Sobolev(20.0))
    problem = ur.Problem(renderer, [unknown], [ur.View(renderer.exact({"map": wanted}))])
    result = ur.optimize(problem, ESTIMATORS[name](), ur.optimizers.Adam(0.02), steps=200)
    assert 1.0 - float(result.parameters["map"].mean()) < most


def test_the_mean_gradient_that_decides_is_full_whether_or_not_a_variance_is_known() -> None:
    gradient = {"map": np.ones((1200, 1000), np.float32), "x": np.ones(2, np.float32)}
    for variance in (None, gradient):
        noise = GradientNoise()
        noise.update(gradient, variance, {"map": gradient["map"]})
        assert noise.mean is not None
        np.testing.assert_allclose(noise.mean["map"], np.full((1200, 1000), 0.1), rtol=1e-6)
