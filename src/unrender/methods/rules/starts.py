"""Starts of few numbers: pictures of other places are compared with that of given values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import listed
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.methods.base import measure
from unrender.methods.plan import Plan
from unrender.methods.rules.exchangeable import owner
from unrender.methods.rules.traits import Traits
from unrender.parameterisations import Bounds
from unrender.scene.bounds import ends_of
from unrender.scene.parameter import ParameterSettings
from unrender.scene.problem import Problem
from unrender.statistics.debiased import normal_equations
from unrender.statistics.paired_losses import difference, mean_and_error

_PER_DIMENSION, _MOST_PLACES, _MOST_POSES = 16, 24, 48
"""Number of compared places per dimension, and maximum number in all dimensions together; the latter for the pose of a shape."""
_NEAR = 16  # number of places around the best pose of a shape
_FAR = 4.0  # largest distance of places without bounds, in lengths of the shape (`ParameterInfo.length`)
_OPEN = 5.0  # range of places above the only bound of numbers that start at it; k of most metals is below 5
_PATHS, _NUMBER = 1 << 15, 3  # paths of one picture, and index of their random numbers
_BETTER, _ERRORS = 0.5, 4.0
"""Ratio of the losses below which another place is taken, and standard errors of their difference."""
_FACTORS = (1e-2, 1e2)  # limits of the common factor of lights in a comparison, within their bounds


@dataclass(frozen=True)
class Place:
    """Values of some unknowns whose picture is much better; its loss without noise, and relative to that of the given values."""

    values: dict[str, np.ndarray]
    share: float
    loss: float


def best_start(traits: Traits, keys: Sequence[str], plan: Plan, plateau: bool = False) -> Plan:
    """Return the plan with the best start among places of some unknowns, if its picture is much better.

    Gauss-Newton steps end in the nearest minimum. Poses of shapes are compared on a plateau alone. Beside unknown colours no places are
    compared, because those of the best picture make up for wrong colours; see `runs.refinement`.

    Args:
        traits: Traits of the problem.
        keys: Keys of the unknowns with Gauss-Newton steps.
        plan: Plan for the problem.
        plateau: Whether the unknowns are poses on a plateau, where any better picture is enough.
    """
    problem = plan.configured()
    varied = [key for key in varied_keys(problem, keys) if plateau or not _is_shape(problem, key)]
    lights = [key for key in traits.lights if key in keys]
    colours = any(traits.infos[key].brightness == "reflectance" for key in keys)
    if not varied or (colours and not plateau):
        return plan
    initial = {key: u.initial if u.first is None else u.first for key, u in problem.unknowns.items()}
    place = measure(
        traits.problem,
        ("place", repr(plan.settings), *varied, *lights, plateau),
        lambda: better_place(
            problem, FreshPictures(traits.problem, 0, _PATHS, _NUMBER), initial, varied, lights, plateau
        ),
    )
    if place is None:
        return plan
    settings = {
        key: replace(
            plan.settings.get(key, ParameterSettings()), start=tuple(map(float, np.ravel(x))), start_factor=None
        )
        for key, x in place.values.items()
    }
    reason = (
        f"starts at other values of {listed(varied)}, where the loss is {place.share:.0%} of that at the initial values"
    )
    return replace(plan, settings={**plan.settings, **settings}, reasons=(*plan.reasons, reason))


def better_place(
    problem: Problem,
    pictures: FreshPictures,
    values: Mapping[str, np.ndarray],
    keys: Sequence[str],
    lights: Sequence[str],
    plateau: bool = False,
) -> Place | None:
    """Return the best of some places within the bounds of unknowns; None unless its loss is at most half, beyond noise.

    Poses are compared shape by shape. Each place is judged by the problem's loss. A common factor of unknown lights is fitted there,
    because a step would find it. Unknowns with a prior keep their values.

    Args:
        problem: Problem with the settings of its plan.
        pictures: Renderer of the pictures.
        values: {key: array}, the given values of all unknowns.
        keys: Keys of the varied unknowns, see `varied_keys`.
        lights: Keys of radiances and other values in which images are linear.
        plateau: Whether any smaller loss is enough, beyond noise.
    """
    unknowns = problem.unknowns
    lights = [key for key in lights if unknowns[key].prior is None]
    limits = _limits([(values[key], unknowns[key].bounds) for key in lights])
    comparison = _Comparison(problem, pictures, values, keys, lights, limits)
    first = best = _Compared({}, 1.0, comparison.losses([values])[0][0])
    for group in _groups(problem, keys):
        best = comparison.best_of_group(group, best)
    start = first.total
    share = max(best.total, 0.0) / start if start > 0.0 else math.inf  # without its noise, a loss may be negative
    change = difference(best.losses, first.losses, sampled=pictures.sampled or not plateau)
    if not share < (1.0 if plateau else _BETTER) or not change.value > _ERRORS * change.standard_error:
        return None
    factor = best.factor
    chosen = {**best.place, **{key: unknowns[key].project(factor * values[key]) for key in lights if factor != 1.0}}
    return Place(chosen, share, best.total)


@dataclass(frozen=True)
class _Compared:
    """Values that differ from the given ones, the factor of the lights, and the pseudo-values of the loss, (K, N)."""

    place: dict[str, np.ndarray]
    factor: float
    losses: np.ndarray

    @property
    def total(self) -> float:
        """The loss, without the picture's noise."""
        return mean_and_error(self.losses)[0]


@dataclass(frozen=True)
class _Comparison:
    """Pictures of places of varied unknowns `keys`, and limits of the common factor of the `lights`."""

    problem: Problem
    pictures: FreshPictures
    values: Mapping[str, np.ndarray]
    keys: Sequence[str]
    lights: Sequence[str]
    limits: Bounds

    def best_of_group(self, keys: Sequence[str], best: _Compared) -> _Compared:
        """Return the best of the places of some unknowns, whose others have their best values so far.

        Places around the best pose of a shape are compared, too, because few of the spread ones overlap its picture in the references.
        """
        problem, before, at = self.problem, best, np.empty(0)
        shape = _is_shape(problem, keys[0])
        points = _points(problem, keys)
        reach = len(points) ** (-1.0 / points.shape[1])
        for _ in range(2 if shape else 1):
            places = [{**before.place, **_values(problem, keys, point, self.values)} for point in points]
            together = len(places) if shape else 1
            for start in range(0, len(places), together):
                part = slice(start, start + together)
                try:
                    losses = self.losses([{**self.values, **place} for place in places[part]])
                except InputError:  # a value that the renderer rejects
                    continue
                for place, point, (own, factor) in zip(places[part], points[part], losses, strict=True):
                    if (made := _Compared(place, factor, own)).total < best.total:
                        best, at = made, point
            if best is before:
                break
            points = np.clip(at + reach * (2.0 * points[:_NEAR] - 1.0), 0.0, 1.0)
        change = difference(best.losses, before.losses, sampled=self.pictures.sampled)
        return best if not shape or change.value > _ERRORS * change.standard_error else before

    def losses(self, states: Sequence[Mapping[str, np.ndarray]]) -> list[tuple[np.ndarray, float]]:
        """Return the pseudo-values of the loss of each state, (K, N), and the factor of its lights: 1 or that of least squares, whichever
        has less loss."""
        pictures = self.pictures
        images_of = pictures.images_of(states, self.keys)
        losses = [(pictures.losses(images), 1.0) for images in images_of]
        if not self.lights:
            return losses
        doubled = [{**state, **{key: 2.0 * state[key] for key in self.lights}} for state in states]
        for index, double in enumerate(pictures.images_of(doubled, self.keys)):
            images = images_of[index]
            own = [two - one for two, one in zip(double, images, strict=True)]
            factor = float(np.clip(_factor(pictures, images, own), *self.limits))
            other = pictures.losses([image + (factor - 1.0) * light for image, light in zip(images, own, strict=True)])
            if mean_and_error(other)[0] < mean_and_error(losses[index][0])[0]:
                losses[index] = other, factor
        return losses


def stands_out(problem: Problem, keys: Sequence[str]) -> bool:
    """Return whether initial poses have a much better picture than at least half of the poses around them.

    These differ in one coordinate, by the length of the object or by a radian. Near the solution they are worse, though noise may hide
    what derivative images explain of the residual. On a plateau they are as good.
    """
    pictures, known = FreshPictures(problem, 0, _PATHS, _NUMBER), problem.renderer.parameters()
    values = {key: unknown.initial for key, unknown in problem.unknowns.items()}
    places = [values]
    for key in keys:
        own, distance = values[key], 1.0 if known[key].angle else known[key].length
        for change in distance * np.concatenate([np.eye(own.size), -np.eye(own.size)]):
            moved = problem.unknowns[key].project(own + change.reshape(own.shape))
            places.append({**values, key: np.asarray(moved, np.float32)})
    first, *others = (pictures.losses(images) for images in pictures.images_of(places, keys))
    worse = 0
    for other in others:
        rise = difference(first, other, sampled=pictures.sampled)
        clear = rise.value > _ERRORS * rise.standard_error
        worse += clear and mean_and_error(first)[0] < _BETTER * mean_and_error(other)[0]
    return 2 * worse >= len(others) > 0


def varied_keys(problem: Problem, keys: Sequence[str]) -> list[str]:
    """Return the keys of unknowns whose places can be compared: directions, and numbers between two bounds that change the form of
    the picture."""
    return [key for key in keys if _dimensions(problem, key)]


def number_of_places(problem: Problem, keys: Sequence[str]) -> int:
    """Return how many places `better_place` compares at most."""
    groups = _groups(problem, keys)
    return sum(len(_points(problem, group)) + _NEAR * _is_shape(problem, group[0]) for group in groups)


def starts_at_bound(problem: Problem, key: str) -> bool:
    """Return whether all values of an unknown that is no pose, brightness or density start at its only bound, a lower one."""
    unknown, info = problem.unknowns[key], problem.renderer.parameters()[key]
    low, high = unknown.bounds
    other = info.rigid or info.viewpoint or info.brightness or info.scattering == "medium"
    return not other and low is not None and high is None and bool((unknown.initial == low).all())


def _dimensions(problem: Problem, key: str) -> int:
    """Return the number of dimensions in which places of an unknown are compared; 0 for none."""
    info, unknown = problem.renderer.parameters()[key], problem.unknowns[key]
    if unknown.prior is not None or unknown.transform is not None:
        return 0
    if info.role == "direction":
        return 2 if unknown.shape() == (3,) else 0
    formed = not info.viewpoint if info.rigid else info.nonlinear or info.scattering or starts_at_bound(problem, key)
    return unknown.initial.size if formed and None not in _range(problem, key, 0.0) else 0


def _is_shape(problem: Problem, key: str) -> bool:
    return problem.renderer.parameters()[key].shape_pose


def _groups(problem: Problem, keys: Sequence[str]) -> list[list[str]]:
    """Return the keys whose places are compared together: those of each shape, and all others."""
    groups: dict[str, list[str]] = {}
    for key in keys:
        groups.setdefault(owner(key) if _is_shape(problem, key) else "", []).append(key)
    return list(groups.values())


def _range(problem: Problem, key: str, value: float) -> Bounds:
    """Return the bounds of an unknown. Without bounds, a rotation has a full turn, and a shape moves by some lengths around a value.

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
    return (value - far, value + far) if _is_shape(problem, key) and info.lowest is None else bounds


def _points(problem: Problem, keys: Sequence[str]) -> np.ndarray:
    """Return well-spread points of the unit cube (Roberts' additive sequence), (N, D)."""
    total = sum(_dimensions(problem, key) for key in keys)
    golden = 2.0
    for _ in range(64):  # the root of x^(d + 1) = x + 1
        golden = (1.0 + golden) ** (1.0 / (total + 1.0))
    most = _MOST_POSES if _is_shape(problem, keys[0]) else _MOST_PLACES
    number = np.arange(1, min(_PER_DIMENSION * total, most) + 1)[:, None]
    return (0.5 + number * golden ** -np.arange(1.0, total + 1.0)) % 1.0


def _values(
    problem: Problem, keys: Sequence[str], point: np.ndarray, around: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return {key: value} of some unknowns at a point of the unit cube."""
    ends = np.cumsum([_dimensions(problem, key) for key in keys])
    return {
        key: _value(problem, key, part, around[key]) for key, part in zip(keys, np.split(point, ends[:-1]), strict=True)
    }


def _value(problem: Problem, key: str, point: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Return the value of an unknown at a point of the unit cube. Without bounds, places are denser near the given value."""
    unknown, info = problem.unknowns[key], problem.renderer.parameters()[key]
    if info.role == "direction":
        z, angle = 2.0 * point[0] - 1.0, 2.0 * math.pi * point[1]
        side = math.sqrt(1.0 - z * z)
        value = np.array([side * math.cos(angle), side * math.sin(angle), z])
    elif _is_shape(problem, key) and unknown.bounds == (None, None) and not info.angle:
        value = around + _FAR * info.length * (2.0 * point.reshape(unknown.initial.shape) - 1.0) ** 3
    else:
        low, high = (float(end or 0.0) for end in _range(problem, key, 0.0))
        value = (low + (high - low) * point).reshape(unknown.initial.shape)
    return np.asarray(unknown.project(value), np.float32)


def _limits(lights: Sequence[tuple[np.ndarray, Bounds]]) -> Bounds:
    """Return the limits of a common factor of values with bounds; 1 is within them."""
    low, high = _FACTORS
    for values, bounds in lights:
        x = np.ravel(values).astype(np.float64)
        below, above = ends_of(bounds)
        ends = np.sort([below / x[x != 0.0], above / x[x != 0.0]], axis=0)
        low, high = float(ends[0].max(initial=low)), float(ends[1].min(initial=high))
    return min(low, 1.0), max(high, 1.0)


def _factor(pictures: FreshPictures, images: Sequence[np.ndarray], own: Sequence[np.ndarray]) -> float:
    """Return the factor of least squares of the part `own` of the images. Products of independent halves have no bias from noise."""
    image, light = (np.concatenate(parts, axis=1) for parts in (images, own))
    own_halves = [light[half::2].mean(axis=0)[None] for half in (0, 1)]
    missing = [pictures.references - image[half::2].mean(axis=0) for half in (0, 1)]
    matrix, vector = normal_equations(own_halves, missing, pictures.weights[:, None])
    return 1.0 + float(vector[0] / max(float(matrix[0, 0]), 1e-300))
