"""Gradients by the poses of lights against differences of Mitsuba's pictures of scenes in which the light was moved for good."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from zscores import z_scores

import unrender as ur
from tests.render.test_light_poses import LIGHTS, light, motion, scene
from unrender.estimators.base import as_numpy
from unrender.rendering.mitsuba.integrators.emitters import EmitterConnection

KINDS = ("point", "spot", "projector", "directional", "rectangle", "envmap", "sunsky")
DEPTH, LEVEL, SPP = 3, 1e-3, 1024
WIDTH = 0.01
"""Half the distance of the differences, in units of the scene, radians, and of the scale as loaded."""
START = {"translation": [0.1, -0.1, 0.15], "rotation": [0.05, 0.1, -0.08], "scale": 1.1}
PARTS = {"translation": "shift", "rotation": "turn", "scale": "scale"}


def parts_of(kind: str) -> tuple[str, ...]:
    return LIGHTS[kind][1]


def start(parts: Sequence[str]) -> dict[str, np.ndarray]:
    return {part: np.array(START[part], np.float64) for part in parts}


def scene_at(kind: str, pose: Mapping[str, np.ndarray]) -> Any:
    """Return Mitsuba's scene in which the light stands at a pose."""
    values: dict[str, Any] = {PARTS[part]: x if x.ndim else float(x) for part, x in pose.items()}
    return mi.load_dict(scene(light(kind, motion(LIGHTS[kind][0], **values))))


def picture(loaded: Any, spp: int, seed: int) -> np.ndarray:
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    return np.array(mi.render(loaded, integrator=path, spp=spp, seed=mi.UInt32(seed)), np.float64)


def slopes(
    kind: str, parts: Sequence[str], reference: np.ndarray, spp: int, seeds: int, axis: int | None = None
) -> np.ndarray:
    """Return differences of the L2 loss by all elements of these parts of the pose, or those of one axis, (seeds, n).

    Both ends share their random numbers. The noise of a picture adds nothing to the loss, which is a product of two independent residuals.
    """
    found = []
    for part, value in start(parts).items():
        for index in np.ndindex(value.shape) if axis is None else [(axis,)]:
            losses = []
            for sign in (1.0, -1.0):
                there = start(parts)
                there[part][index] += sign * WIDTH
                loaded = scene_at(kind, there)
                pairs = [
                    [picture(loaded, spp, 2 * seed + half) - reference for half in (0, 1)] for seed in range(seeds)
                ]
                losses.append([np.mean(one * other) for one, other in pairs])
            found.append(np.subtract(*losses) / (2 * WIDTH))
    return np.stack(found, axis=1)


def gradients(kind: str, parts: Sequence[str], reference: np.ndarray, estimator: Any, runs: int) -> np.ndarray:
    """Return independent estimates of the gradient, (runs, n)."""
    unknown = [ur.Parameter(f"lamp.{part}", initial=value) for part, value in start(parts).items()]
    problem = ur.Problem(scene(light(kind)), unknown, [ur.View(reference.astype(np.float32))], max_depth=DEPTH)
    point, found = problem.initial(), []
    for seed in range(runs):
        estimate = estimator.estimate(problem, point, estimator.init(problem, point), ur.Key(seed))[0]
        gradient = as_numpy(estimate).gradient
        found.append(np.concatenate([np.ravel(gradient[parameter.key]) for parameter in unknown]))
    return np.array(found, np.float64)


def reference_of(kind: str, parts: Sequence[str]) -> np.ndarray:
    still = {part: np.array(1.0 if part == "scale" else np.zeros(3)) for part in parts}
    return 0.5 * picture(scene_at(kind, still), 256, 1000)  # darker: most of the slope is not at edges of shadows


@cache
def reference_and_slopes(kind: str, parts: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the reference picture, and independent slopes of the loss, (seeds, n)."""
    reference = reference_of(kind, parts)
    return reference, slopes(kind, parts, reference, SPP, 8)


def compare(kind: str, estimator: Any, runs: int, parts: tuple[str, ...] = ()) -> None:
    """Compare all elements by their measured standard errors, after Šidák; a gradient of which a quarter is missing is found out."""
    parts = parts or parts_of(kind)
    reference, expected = reference_and_slopes(kind, parts)
    found = gradients(kind, parts, reference, estimator, runs)
    seen = np.abs(expected.mean(axis=0)) > 1e-9  # a point light's direction does not show, nor does an axis of symmetry
    z = z_scores(found[:, seen], expected[:, seen])
    limit = stats.norm.isf((1 - (1 - LEVEL) ** (1 / z.size)) / 2)
    assert np.abs(z).max() < limit, (kind, z)
    assert np.abs(z_scores(0.75 * found[:, seen], expected[:, seen])).max() > limit, "a lost quarter went unseen"


@pytest.mark.slow  # in the quick tier, render/test_light_poses.py compares pictures of all posed lights with those of moved lights
@pytest.mark.parametrize("kind", KINDS)
def test_gauss_newton_gradients_are_the_slope_of_the_loss(kind: str) -> None:
    """The widths of its differences are as small as those here: at five times the shift, edges of shadows cross several pixels."""
    compare(kind, ur.GaussNewton(shift=0.01, derivative_spp=256), 12)


def test_the_path_gradient_of_a_turn_is_the_slope_of_the_loss() -> None:
    """The quick twin of the test below: one axis of an environment map."""
    kind, parts = "envmap", ("rotation",)
    reference = reference_of(kind, parts)
    expected = slopes(kind, parts, reference, 512, 6, axis=0)
    found = gradients(kind, parts, reference, ur.PathGradient(spp=512), 8)[:, :1]
    limit = stats.norm.isf(LEVEL / 2)
    assert abs(z_scores(found, expected)[0]) < limit
    assert abs(z_scores(0.75 * found, expected)[0]) > limit, "a lost quarter went unseen"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["spot", "envmap"])
def test_path_gradients_of_rotations_are_the_slope_of_the_loss(kind: str) -> None:
    """Light bounces between floor and ball, and the ball has shadows."""
    compare(kind, ur.PathGradient(spp=256), 32, ("rotation",))


@pytest.mark.slow
def test_without_the_derivative_of_sampled_environments_the_gradient_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EmitterConnection, "_turned", lambda self, emitter, radiance: radiance)
    with pytest.raises(AssertionError, match="envmap"):
        compare("envmap", ur.PathGradient(spp=256), 32, ("rotation",))


@pytest.mark.slow
def test_smoothed_gradients_are_the_slope_of_the_loss() -> None:
    compare("spot", ur.SmoothedDerivatives(WIDTH, samples=128, spp=32, debiased=True), 48)
