"""Places of few numbers: values of unknowns that are compared, at points of the unit cube."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from unrender.methods.rules.exchangeable import owner
from unrender.parameterisations import Bounds
from unrender.scene.bounds import ends_of
from unrender.scene.problem import Problem

_PER_DIMENSION, _MOST_PLACES, _MOST_POSES = 16, 24, 48
"""Number of compared places per dimension, and maximum number in all dimensions together; the latter for the pose of a shape."""
_FAR = 4.0  # largest distance of places without bounds, in lengths of the shape (`ParameterInfo.length`)
_RATIO = 10.0  # largest ratio of places to positive numbers without an upper bound, and of these to places
_OPEN = 5.0  # range of places above the only bound of numbers that start at it; k of most metals is below 5


def varied_keys(problem: Problem, keys: Sequence[str]) -> list[str]:
    """Return the keys of unknowns whose places can be compared: directions, and numbers with a lower bound that change the form of the
    picture."""
    return [key for key in keys if dimensions(problem, key)]


def starts_at_bound(problem: Problem, key: str) -> bool:
    """Return whether all values of an unknown that is no pose, brightness or density start at its only bound, a lower one."""
    unknown, info = problem.unknowns[key], problem.renderer.parameters()[key]
    low, high = unknown.bounds
    other = info.rigid or info.viewpoint or info.brightness or info.scattering == "medium"
    return not other and low is not None and high is None and bool((unknown.initial == low).all())


def dimensions(problem: Problem, key: str) -> int:
    """Return the number of dimensions in which places of an unknown are compared; 0 for none."""
    info, unknown = problem.renderer.parameters()[key], problem.unknowns[key]
    scale = is_scale(problem, key)
    if unknown.prior is not None or (unknown.transform is not None and not scale):
        return 0
    if info.role == "direction":
        return 2 if unknown.shape() == (3,) else 0
    formed = not info.viewpoint if info.rigid else info.nonlinear or info.scattering or starts_at_bound(problem, key)
    return unknown.initial.size if formed and (scale or None not in _range(problem, key)) else 0


def is_scale(problem: Problem, key: str) -> bool:
    """Return whether all values of an unknown start above its only bound, a lower one, as those of an extinction or an aperture."""
    unknown = problem.unknowns[key]
    low, high = unknown.bounds
    open_above = low is not None and high is None and not problem.renderer.parameters()[key].rigid
    return open_above and bool((unknown.initial > low).all())


def has_scale(problem: Problem, keys: Sequence[str]) -> bool:
    return any(is_scale(problem, key) for key in keys)


def is_shape(problem: Problem, key: str) -> bool:
    return problem.renderer.parameters()[key].shape_pose


def groups(problem: Problem, keys: Sequence[str]) -> list[list[str]]:
    """Return the keys whose places are compared together: those of each shape, and all others."""
    groups: dict[str, list[str]] = {}
    for key in keys:
        groups.setdefault(owner(key) if is_shape(problem, key) else "", []).append(key)
    return list(groups.values())


def _range(problem: Problem, key: str) -> Bounds:
    """Return the bounds of an unknown. Without bounds, a rotation has a full turn, and a shape moves by some lengths.

    Numbers that start at their only bound, a lower one, have a range above it. Pictures may hardly change there: those of a metal are even
    functions of k.
    """
    bounds, info = problem.unknowns[key].bounds, problem.renderer.parameters()[key]
    if starts_at_bound(problem, key):
        low = ends_of(bounds)[0]
        return low, low + _OPEN
    if bounds != (None, None) or not info.rigid:
        return bounds
    if info.angle:
        return -math.pi, math.pi
    far = _FAR * info.length
    return (-far, far) if is_shape(problem, key) and info.lowest is None else bounds


def points(problem: Problem, keys: Sequence[str]) -> np.ndarray:
    """Return well-spread points of the unit cube (Roberts' additive sequence), (N, D)."""
    total = sum(dimensions(problem, key) for key in keys)
    golden = 2.0
    for _ in range(64):  # the root of x^(d + 1) = x + 1
        golden = (1.0 + golden) ** (1.0 / (total + 1.0))
    most = _MOST_POSES if is_shape(problem, keys[0]) else _MOST_PLACES
    number = np.arange(1, min(_PER_DIMENSION * total, most) + 1)[:, None]
    return (0.5 + number * golden ** -np.arange(1.0, total + 1.0)) % 1.0


def values_at(
    problem: Problem, keys: Sequence[str], point: np.ndarray, around: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return {key: value} of some unknowns at a point of the unit cube."""
    ends = np.cumsum([dimensions(problem, key) for key in keys])
    return {
        key: _value(problem, key, part, around[key]) for key, part in zip(keys, np.split(point, ends[:-1]), strict=True)
    }


def _value(problem: Problem, key: str, point: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Return the value of an unknown at a point of the unit cube. Without bounds, places are denser near the given value; with a lower one
    alone, their logarithms are spread around that of the initial value."""
    unknown, info = problem.unknowns[key], problem.renderer.parameters()[key]
    if info.role == "direction":
        z, angle = 2.0 * point[0] - 1.0, 2.0 * math.pi * point[1]
        side = math.sqrt(1.0 - z * z)
        value = np.array([side * math.cos(angle), side * math.sin(angle), z])
    elif is_shape(problem, key) and unknown.bounds == (None, None) and not info.angle:
        value = around + _FAR * info.length * (2.0 * point.reshape(unknown.initial.shape) - 1.0) ** 3
    elif is_scale(problem, key):
        low = ends_of(unknown.bounds)[0]
        value = low + (unknown.initial - low) * _RATIO ** (2.0 * point.reshape(unknown.initial.shape) - 1.0)
    else:
        low, high = (float(end or 0.0) for end in _range(problem, key))
        value = (low + (high - low) * point).reshape(unknown.initial.shape)
    return np.asarray(unknown.project(value), np.float32)


def coordinates_of(problem: Problem, keys: Sequence[str], values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the point of the unit cube at which `values_at` returns the given values, or the nearest one."""
    parts = []
    for key in keys:
        x, initial = (np.ravel(of).astype(np.float64) for of in (values[key], problem.unknowns[key].initial))
        if problem.renderer.parameters()[key].role == "direction":
            x = x / max(float(np.linalg.norm(x)), 1e-300)
            parts.append(np.array([0.5 + 0.5 * x[2], math.atan2(x[1], x[0]) / (2.0 * math.pi) % 1.0]))
        elif is_scale(problem, key):
            low = ends_of(problem.unknowns[key].bounds)[0]
            ratios = np.maximum(x - low, 1e-300) / (initial - low)
            parts.append(0.5 + 0.5 * np.log(ratios) / math.log(_RATIO))
        else:
            low, high = (float(end or 0.0) for end in _range(problem, key))
            parts.append((x - low) / (high - low))
    return np.clip(np.concatenate(parts), 0.0, 1.0)
