"""Starts of few numbers: pictures of other places within their bounds are compared with that of the given start."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import listed
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.methods.plan import Plan
from unrender.methods.rules.traits import Traits
from unrender.parameterisations.base import Bounds
from unrender.scene.parameter import ParameterSettings

__all__ = ["best_start"]

_PER_DIMENSION, _MOST_PLACES = 8, 24
"""Number of compared places per dimension, and its maximum."""
_PATHS, _NUMBER = 1 << 15, 3
"""Paths of one picture, and index of their random numbers."""
_BETTER, _ERRORS = 0.5, 4.0
"""Ratio of the mean square differences from the references below which another place is taken, and standard errors of the change."""
_ROTATION = "rotation"
"""Part of the keys of angles, in radians."""
_FACTORS = (1e-2, 1e2)
"""Limits of the common factor of lights in a comparison."""


def best_start(traits: Traits, keys: Sequence[str], plan: Plan) -> Plan:
    """Return the plan with the best start among places within the bounds of some unknowns, if its picture is much better.

    Gauss-Newton steps end in the nearest minimum. Places are compared in directions, and in numbers between two bounds that change the
    form of the picture. A common factor of unknown lights is fitted at each place, because a step would find it.

    Args:
        traits: Traits of the problem.
        keys: Keys of the unknowns with Gauss-Newton steps.
        plan: Plan for the problem.
    """
    varied = [key for key in keys if _dimensions(traits, key)]
    if not varied:
        return plan
    problem, initial = traits.problem, traits.problem.initial_values()
    pictures = FreshPictures(problem, 0, _PATHS, _NUMBER)
    lights = [key for key in traits.lights if key in keys]
    first = _squares(pictures, initial, lights)
    best, factor, least = {}, 1.0, math.inf
    for place in _places(traits, varied):
        try:
            squares, own = _squares(pictures, {**initial, **place}, lights)
        except InputError:  # a value that the renderer rejects
            continue
        if (total := float(squares.sum())) < least:
            best, factor, least, change = place, own, total, first[0] - squares
    start = float(first[0].sum())
    share = max(least, 0.0) / start if start > 0.0 else math.inf  # noise may leave a negative difference
    if not share < _BETTER or not change.mean() > _ERRORS * change.std() / math.sqrt(change.size):
        return plan
    chosen = {**best, **{key: factor * initial[key] for key in lights if factor != 1.0}}
    settings = {key: ParameterSettings(start=tuple(map(float, np.ravel(x)))) for key, x in chosen.items()}
    reason = (
        f"starts at another place within the bounds of {listed(varied)}, where the picture's mean square difference is {share:.0%} of that "
        "at the initial values"
    )
    return replace(plan, settings={**plan.settings, **settings}, reasons=(*plan.reasons, reason))


def _dimensions(traits: Traits, key: str) -> int:
    """Return the number of dimensions in which places of an unknown are compared; 0 for none."""
    info, unknown = traits.infos[key], traits.problem.unknowns[key]
    if unknown.prior is not None or unknown.transform is not None:
        return 0
    if info.role == "direction":
        return 2 if unknown.shape() == (3,) else 0
    formed = info.light if info.rigid else info.nonlinear
    return unknown.initial.size if formed and None not in _range(traits, key) else 0


def _range(traits: Traits, key: str) -> Bounds:
    """Return the bounds of an unknown; a full turn for the rotation of a light without bounds."""
    bounds = traits.problem.unknowns[key].bounds
    turns = traits.infos[key].rigid and _ROTATION in key.split(".")
    return (-math.pi, math.pi) if turns and bounds == (None, None) else bounds


def _places(traits: Traits, keys: Sequence[str]) -> list[dict[str, np.ndarray]]:
    """Return well-spread places (Roberts' additive sequence) within the bounds of the unknowns."""
    dimensions = [_dimensions(traits, key) for key in keys]
    total = sum(dimensions)
    golden = 2.0
    for _ in range(64):  # the root of x^(d + 1) = x + 1
        golden = (1.0 + golden) ** (1.0 / (total + 1.0))
    number = np.arange(1, min(_PER_DIMENSION * total, _MOST_PLACES) + 1)[:, None]
    points = (0.5 + number * golden ** -np.arange(1.0, total + 1.0)) % 1.0
    parts = np.split(points, np.cumsum(dimensions)[:-1], axis=1)
    return [
        {key: _value(traits, key, part[i]) for key, part in zip(keys, parts, strict=True)} for i in range(len(points))
    ]


def _value(traits: Traits, key: str, point: np.ndarray) -> np.ndarray:
    """Return the value of an unknown at a point of the unit cube."""
    unknown = traits.problem.unknowns[key]
    if traits.infos[key].role == "direction":
        z, angle = 2.0 * point[0] - 1.0, 2.0 * math.pi * point[1]
        side = math.sqrt(1.0 - z * z)
        value = np.array([side * math.cos(angle), side * math.sin(angle), z])
    else:
        low, high = (float(end or 0.0) for end in _range(traits, key))
        value = (low + (high - low) * point).reshape(unknown.initial.shape)
    return np.asarray(unknown.project(value), np.float32)


def _squares(
    pictures: FreshPictures, values: Mapping[str, np.ndarray], lights: Sequence[str]
) -> tuple[np.ndarray, float]:
    """Return the squared difference from the references of each pixel, (N,), without noise, and the fitted factor of the lights."""
    weights, references = pictures.weights, pictures.references
    images = np.concatenate(pictures.images(values), axis=1)
    halves, factor = [images[0::2].mean(axis=0), images[1::2].mean(axis=0)], 1.0
    if lights:
        double = np.concatenate(pictures.images({**values, **{key: 2.0 * values[key] for key in lights}}), axis=1)
        of = [(double[half::2] - images[half::2]).mean(axis=0) for half in (0, 1)]
        missing = [references - image for image in halves]
        products = ((of[0] * missing[1] + of[1] * missing[0]).sum(axis=1) * weights).sum()
        factor = 1.0 + float(products / max(2.0 * ((of[0] * of[1]).sum(axis=1) * weights).sum(), 1e-300))
        factor = float(np.clip(factor, *_FACTORS))
        halves = [image + (factor - 1.0) * own for image, own in zip(halves, of, strict=True)]
    squares = ((halves[0] - references) * (halves[1] - references)).sum(axis=1) * weights
    return np.where(np.isfinite(squares), squares, np.inf), factor
