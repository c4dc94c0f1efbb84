"""Starts of few numbers: pictures of other places within their bounds are compared with that of given values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import listed
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.methods.plan import Plan
from unrender.methods.rules.traits import Traits
from unrender.parameterisations import Bounds
from unrender.scene.parameter import ParameterSettings
from unrender.scene.problem import Problem
from unrender.statistics.debiased import normal_equations
from unrender.statistics.paired_losses import difference, mean_and_error

_PER_DIMENSION, _MOST_PLACES = 16, 24
"""Number of compared places per dimension, and maximum number in all dimensions together."""
_PATHS, _NUMBER = 1 << 15, 3
"""Paths of one picture, and index of their random numbers."""
_BETTER, _ERRORS = 0.5, 4.0
"""Ratio of the losses below which another place is taken, and standard errors of their difference."""
_ROTATION = "rotation"
"""Part of the keys of angles, in radians."""
_FACTORS = (1e-2, 1e2)
"""Limits of the common factor of lights in a comparison, within their bounds."""


@dataclass(frozen=True)
class Place:
    """Values of some unknowns whose picture is much better.

    Attributes:
        values: {key: array} of the unknowns that change.
        share: loss there relative to that of the given values.
        loss: loss there, without the picture's noise.
    """

    values: dict[str, np.ndarray]
    share: float
    loss: float


def best_start(traits: Traits, keys: Sequence[str], plan: Plan) -> Plan:
    """Return the plan with the best start among places within the bounds of some unknowns, if its picture is much better.

    Gauss-Newton steps end in the nearest minimum.

    Args:
        traits: Traits of the problem.
        keys: Keys of the unknowns with Gauss-Newton steps.
        plan: Plan for the problem.
    """
    problem = plan.configured()
    varied, lights = varied_keys(problem, keys), [key for key in traits.lights if key in keys]
    if not varied:
        return plan
    initial = {key: u.initial if u.first is None else u.first for key, u in problem.unknowns.items()}
    place = better_place(problem, FreshPictures(traits.problem, 0, _PATHS, _NUMBER), initial, varied, lights)
    if place is None:
        return plan
    settings = {
        key: replace(
            plan.settings.get(key, ParameterSettings()), start=tuple(map(float, np.ravel(x))), start_factor=None
        )
        for key, x in place.values.items()
    }
    where = f"starts at another place within the bounds of {listed(varied)}"
    reason = f"{where}, where the loss is {place.share:.0%} of that at the initial values"
    return replace(plan, settings={**plan.settings, **settings}, reasons=(*plan.reasons, reason))


def better_place(
    problem: Problem,
    pictures: FreshPictures,
    values: Mapping[str, np.ndarray],
    keys: Sequence[str],
    lights: Sequence[str],
) -> Place | None:
    """Return the best of some places within the bounds of unknowns; None unless its loss is at most half, beyond noise.

    Each place is judged by the problem's loss. A common factor of unknown lights is fitted there, because a step would find it. Unknowns
    with a prior keep their values.

    Args:
        problem: Problem with the settings of its plan.
        pictures: Renderer of the pictures.
        values: {key: array}, the given values of all unknowns.
        keys: Keys of the varied unknowns, see `varied_keys`.
        lights: Keys of radiances and other values in which images are linear.
    """
    unknowns = problem.unknowns
    lights = [key for key in lights if unknowns[key].prior is None]
    limits = _limits([(values[key], unknowns[key].bounds) for key in lights])
    first, _ = _losses(pictures, values, lights, limits)
    best, factor, least = {}, 1.0, math.inf
    for place in _places(problem, keys):
        try:
            losses, own = _losses(pictures, {**values, **place}, lights, limits)
        except InputError:  # a value that the renderer rejects
            continue
        if (total := mean_and_error(losses)[0]) < least:
            best, factor, least, change = place, own, total, difference(losses, first, sampled=True)
    start = mean_and_error(first)[0]
    share = max(least, 0.0) / start if start > 0.0 else math.inf  # without its noise, a loss may be negative
    if not share < _BETTER or not change.value > _ERRORS * change.standard_error:
        return None
    chosen = {**best, **{key: unknowns[key].project(factor * values[key]) for key in lights if factor != 1.0}}
    return Place(chosen, share, least)


def varied_keys(problem: Problem, keys: Sequence[str]) -> list[str]:
    """Return the keys of unknowns whose places can be compared: directions, and numbers between two bounds that change the form of
    the picture."""
    return [key for key in keys if _dimensions(problem, key)]


def _dimensions(problem: Problem, key: str) -> int:
    """Return the number of dimensions in which places of an unknown are compared; 0 for none."""
    info, unknown = problem.renderer.parameters()[key], problem.unknowns[key]
    if unknown.prior is not None or unknown.transform is not None:
        return 0
    if info.role == "direction":
        return 2 if unknown.shape() == (3,) else 0
    formed = info.light if info.rigid else info.nonlinear or info.scattering
    return unknown.initial.size if formed and None not in _range(problem, key) else 0


def _range(problem: Problem, key: str) -> Bounds:
    """Return the bounds of an unknown; a full turn for the rotation of a light without bounds."""
    bounds = problem.unknowns[key].bounds
    turns = problem.renderer.parameters()[key].rigid and _ROTATION in key.split(".")
    return (-math.pi, math.pi) if turns and bounds == (None, None) else bounds


def _places(problem: Problem, keys: Sequence[str]) -> list[dict[str, np.ndarray]]:
    """Return well-spread places (Roberts' additive sequence) within the bounds of the unknowns."""
    dimensions = [_dimensions(problem, key) for key in keys]
    total = sum(dimensions)
    golden = 2.0
    for _ in range(64):  # the root of x^(d + 1) = x + 1
        golden = (1.0 + golden) ** (1.0 / (total + 1.0))
    number = np.arange(1, min(_PER_DIMENSION * total, _MOST_PLACES) + 1)[:, None]
    points = (0.5 + number * golden ** -np.arange(1.0, total + 1.0)) % 1.0
    parts = np.split(points, np.cumsum(dimensions)[:-1], axis=1)
    return [
        {key: _value(problem, key, part[i]) for key, part in zip(keys, parts, strict=True)} for i in range(len(points))
    ]


def _value(problem: Problem, key: str, point: np.ndarray) -> np.ndarray:
    """Return the value of an unknown at a point of the unit cube."""
    unknown = problem.unknowns[key]
    if problem.renderer.parameters()[key].role == "direction":
        z, angle = 2.0 * point[0] - 1.0, 2.0 * math.pi * point[1]
        side = math.sqrt(1.0 - z * z)
        value = np.array([side * math.cos(angle), side * math.sin(angle), z])
    else:
        low, high = (float(end or 0.0) for end in _range(problem, key))
        value = (low + (high - low) * point).reshape(unknown.initial.shape)
    return np.asarray(unknown.project(value), np.float32)


def _limits(lights: Sequence[tuple[np.ndarray, Bounds]]) -> Bounds:
    """Return the limits of a common factor of values with bounds; 1 is within them."""
    low, high = _FACTORS
    for values, bounds in lights:
        x = np.ravel(values).astype(np.float64)
        below, above = (
            default if end is None else end for end, default in zip(bounds, (-math.inf, math.inf), strict=True)
        )
        ends = np.sort([below / x[x != 0.0], above / x[x != 0.0]], axis=0)
        low, high = float(ends[0].max(initial=low)), float(ends[1].min(initial=high))
    return min(low, 1.0), max(high, 1.0)


def _losses(
    pictures: FreshPictures, values: Mapping[str, np.ndarray], lights: Sequence[str], limits: Bounds
) -> tuple[np.ndarray, float]:
    """Return the pseudo-values of the loss, (K, N), and the factor of the lights: 1 or that of least squares, whichever has less loss."""
    images = pictures.images(values)
    losses = pictures.losses(images)
    if not lights:
        return losses, 1.0
    double = pictures.images({**values, **{key: 2.0 * values[key] for key in lights}})
    own = [two - one for two, one in zip(double, images, strict=True)]
    factor = float(np.clip(_factor(pictures, images, own), *limits))
    others = pictures.losses([image + (factor - 1.0) * light for image, light in zip(images, own, strict=True)])
    return (others, factor) if mean_and_error(others)[0] < mean_and_error(losses)[0] else (losses, 1.0)


def _factor(pictures: FreshPictures, images: Sequence[np.ndarray], own: Sequence[np.ndarray]) -> float:
    """Return the factor of least squares of the part `own` of the images. Products of independent halves have no bias from noise."""
    image, light = (np.concatenate(parts, axis=1) for parts in (images, own))
    own_halves = [light[half::2].mean(axis=0)[None] for half in (0, 1)]
    missing = [pictures.references - image[half::2].mean(axis=0) for half in (0, 1)]
    matrix, vector = normal_equations(own_halves, missing, pictures.weights[:, None])
    return 1.0 + float(vector[0] / max(float(matrix[0, 0]), 1e-300))
