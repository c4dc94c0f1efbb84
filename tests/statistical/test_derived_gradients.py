"""Gradients of ties, of expressions and of a displaced mesh against differences of Mitsuba's pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from zscores import z_scores

import unrender as ur
from tests.render import test_expressions, test_ties
from unrender.core.random import Key
from unrender.estimators.base import as_numpy
from unrender.gallery.heights import Lenses
from unrender.rendering.mitsuba.scene_loading import load

pytestmark = [pytest.mark.slow, pytest.mark.mitsuba]

LEVEL = 1e-3
Values = dict[str, np.ndarray]
Picture = Callable[[Values, int], np.ndarray]
"""Picture of values of the unknowns and a seed, (H, W, 3)."""


def slopes(
    picture: Picture, start: Values, reference: np.ndarray, widths: Mapping[str, float], seed: int
) -> np.ndarray:
    """Return central differences of the L2 loss by all elements.

    Both ends share their random numbers. The noise of a picture adds nothing to the loss, which is a product of two independent residuals.
    """
    found = []
    for key, value in start.items():
        for index in np.ndindex(value.shape):
            losses = []
            for sign in (1.0, -1.0):
                there = {name: np.array(x, np.float64) for name, x in start.items()}
                there[key][index] += sign * widths[key]
                one, other = (picture(there, 2 * seed + half) - reference for half in (0, 1))
                losses.append(np.mean(one * other))
            found.append((losses[0] - losses[1]) / (2.0 * widths[key]))
    return np.array(found)


def compare(
    problem: ur.Problem, estimator: Any, runs: int, expected: np.ndarray, keys: tuple[str, ...], fault: float = 0.75
) -> None:
    """Compare all elements by their measured standard errors, after Šidák; a gradient times `fault` is found out."""
    point, found = problem.initial(), []
    for seed in range(runs):
        estimate = estimator.estimate(problem, point, estimator.init(problem, point), Key(seed))[0]
        gradient = as_numpy(estimate).gradient
        found.append(np.concatenate([np.ravel(gradient[key]) for key in keys]))
    rows = np.array(found, np.float64)
    z, faulty = z_scores(rows, expected), z_scores(fault * rows, expected)
    limit = stats.norm.isf((1 - (1 - LEVEL) ** (1 / z.size)) / 2)
    assert np.abs(z).max() < limit, z
    assert np.abs(faulty).max() > limit, "the fault went unseen"


def rendered(scene: Any, values: Mapping[str, np.ndarray], seed: int, spp: int = 256, depth: int = 3) -> np.ndarray:
    """Return Mitsuba's picture of a scene with these values of its own parameters."""
    loaded = mi.load_dict(scene(), optimize=False)  # equal BSDFs stay apart
    parameters: Any = mi.traverse(loaded)
    for key, value in values.items():
        like = parameters[key]
        parameters[key] = type(like)(*np.ravel(value).tolist()) if np.ndim(value) < 2 else mi.TensorXf(value)
    parameters.update()
    path = mi.load_dict({"type": "path", "max_depth": depth})
    return np.array(mi.render(loaded, integrator=path, spp=spp, seed=mi.UInt32(seed)), np.float64)


def test_the_gradient_of_ties_is_the_slope_of_the_loss() -> None:
    """Two spheres of one roughness, and two lamps of which one has half the intensity."""

    def picture(values: Values, seed: int) -> np.ndarray:
        gloss, light = float(values["gloss"]), values["light"]
        members = {test_ties.LEFT: gloss, test_ties.RIGHT: gloss}
        of_lamps = {test_ties.LAMPS[0]: light, test_ties.LAMPS[1]: 0.5 * light}
        return rendered(test_ties.scene, {**{key: np.array(x) for key, x in members.items()}, **of_lamps}, seed)

    start = {"gloss": np.array(0.25), "light": np.array([5.0, 5.0, 2.5])}
    reference = picture({"gloss": np.array(0.35), "light": np.array([7.0, 6.0, 3.0])}, 99)
    keys = {"gloss": [test_ties.LEFT, test_ties.RIGHT], "light": dict(zip(test_ties.LAMPS, (1.0, 0.5), strict=True))}
    unknown = [ur.Parameter(key, initial=start[key], keys=of) for key, of in keys.items()]
    problem = ur.Problem(test_ties.scene, unknown, [ur.View(reference)], max_depth=3)
    widths = {"gloss": 0.005, "light": 0.05}
    expected = np.stack([slopes(picture, start, reference, widths, seed) for seed in range(6)])
    compare(problem, ur.PathGradient(spp=64), 16, expected, tuple(start))


def test_the_gradient_of_expressions_is_the_slope_of_the_loss() -> None:
    """Two lamps of one strength, and a wall whose texture mixes two colours by a mask."""
    mask = np.linspace(0.0, 1.0, test_expressions.ROWS**2).reshape(test_expressions.ROWS, test_expressions.ROWS, 1)

    def picture(values: Values, seed: int) -> np.ndarray:
        strength, (one, other) = values["strength"], values["palette"]
        tint = float(strength) * np.array([1.0, 0.8, 0.6])
        wall = ((1.0 - mask) * one + mask * other).astype(np.float32)
        keys = test_expressions.LEFT, test_expressions.RIGHT, test_expressions.PAINT
        return rendered(test_expressions.scene, dict(zip(keys, (tint, 0.5 * tint, wall), strict=True)), seed)

    start = {"strength": np.array(2.0), "palette": np.array([[0.6, 0.5, 0.4], [0.2, 0.3, 0.4]])}
    reference = picture({"strength": np.array(3.0), "palette": np.array([[0.8, 0.5, 0.3], [0.3, 0.3, 0.6]])}, 99)
    expressions = {**test_expressions.LAMPS, test_expressions.PAINT: "mix(palette[0], palette[1], mask)"}
    unknown = [ur.Parameter(key, initial=x) for key, x in start.items()]
    fixed = ur.Parameter("mask", initial=mask)
    problem = test_expressions.problem(reference, expressions, *unknown, fixed, max_depth=3)
    expected = np.stack([slopes(picture, start, reference, {"strength": 0.02, "palette": 0.01}, n) for n in range(6)])
    compare(problem, ur.PathGradient(spp=64), 16, expected, tuple(start))


def test_the_gradient_of_displaced_lenses_is_the_slope_of_the_loss() -> None:
    """Gauss-Newton's gradient by path tracing against differences of caustics by Mitsuba's `ptracer`."""
    lenses = Lenses(resolution=12, mesh_resolution=24, reference_spp=1)
    tracer = mi.load_dict({"type": "ptracer", "max_depth": lenses.max_depth, "hide_emitters": False})

    def picture(values: Values, seed: int) -> np.ndarray:
        scene = load(lambda: lenses._stage(values["height"]))
        return np.array(mi.render(scene, integrator=tracer, spp=2048, seed=mi.UInt32(seed)), np.float64)

    start = {"height": np.array([0.12, 0.12, 0.12])}
    reference = picture({"height": np.array([0.06, 0.08, 0.14])}, 99)  # from 0.2 the first slope is hidden by noise
    problem = lenses.problem("lenses").replaced(views=[ur.View(reference.astype(np.float32))])
    expected = np.stack([slopes(picture, start, reference, {"height": 0.005}, seed) for seed in range(6)])
    compare(problem, ur.GaussNewton(spp=2048, shift=0.02, derivative_spp=2048), 16, expected, tuple(start), fault=0.5)
