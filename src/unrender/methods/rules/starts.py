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
from unrender.methods.rules import places
from unrender.methods.rules.traits import Traits
from unrender.parameterisations import Bounds
from unrender.scene.bounds import ends_of
from unrender.scene.parameter import ParameterSettings
from unrender.scene.problem import Problem
from unrender.statistics.debiased import normal_equations
from unrender.statistics.paired_losses import difference, mean_and_error

_NEAR = 16  # number of places around the best pose of a shape
_DESCENTS, _OF_MEDIA, _JUDGED = 8, 4, 3
"""Number of places from which such numbers descend; the same for numbers of media, whose pictures take long; number of ends that are
compared."""
_DIFFERENCE, _DAMPING, _LONGEST, _SHORTER = 0.02, 0.01, 0.25, 0.3
"""Differences and damping of these descents, their longest step relative to the range, and its factor where the loss rises."""
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
    # A descent from near values arrives, where noise of these pictures may choose another minimum: scales wait for `OtherStart`.
    varied = [key for key in places.varied_keys(problem, keys) if not places.is_scale(problem, key)]
    varied = [key for key in varied if plateau or not places.is_shape(problem, key)]
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
    judged: FreshPictures | None = None,
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
        judged: Renderer of the pictures by which the best place is compared with the given values; None for `pictures`.
    """
    unknowns = problem.unknowns
    lights = [key for key in lights if unknowns[key].prior is None]
    limits = _limits([(values[key], unknowns[key].bounds) for key in lights])
    comparison = _Comparison(problem, pictures, values, keys, lights, limits)
    judge = replace(comparison, pictures=judged or pictures)
    first = best = _Compared({}, 1.0, comparison.losses([values])[0][0])
    for group in places.groups(problem, keys):
        if places.has_scale(problem, group):
            best = min((best, *comparison.descended(group, best)), key=lambda place: judge.compared(place).total)
        else:
            best = comparison.best_of_group(group, best)
    if judged is not None:
        first, best = judge.compared(first), judge.compared(best)
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
class _Descent:
    """A place, and its point of the unit cube."""

    x: np.ndarray
    at: _Compared

    def total(self) -> float:
        """Return the loss of the place, without the picture's noise; infinite for a picture that is not finite."""
        return self.at.total if math.isfinite(self.at.total) else math.inf


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
        shape = places.is_shape(problem, keys[0])
        points = places.points(problem, keys)
        reach = len(points) ** (-1.0 / points.shape[1])
        for _ in range(2 if shape else 1):
            tried = [{**before.place, **places.values_at(problem, keys, point, self.values)} for point in points]
            together = len(tried) if shape else 1
            for start in range(0, len(tried), together):
                part = slice(start, start + together)
                try:
                    losses = self.losses([{**self.values, **place} for place in tried[part]])
                except InputError:  # a value that the renderer rejects
                    continue
                for place, point, (own, factor) in zip(tried[part], points[part], losses, strict=True):
                    if (made := _Compared(place, factor, own)).total < best.total:
                        best, at = made, point
            if best is before:
                break
            points = np.clip(at + reach * (2.0 * points[:_NEAR] - 1.0), 0.0, 1.0)
        change = difference(best.losses, before.losses, sampled=self.pictures.sampled)
        return best if not shape or change.value > _ERRORS * change.standard_error else before

    def compared(self, state: _Compared) -> _Compared:
        """Return the same place with the losses of these pictures."""
        ((losses, factor),) = self.losses([{**self.values, **state.place}])
        return _Compared(state.place, factor, losses)

    def descended(self, keys: Sequence[str], best: _Compared) -> list[_Compared]:
        """Return the ends of least squares from the given values and from the best of the places that have the least loss.

        Places in a wide range are far apart, and the best of them often lies beside another minimum. So several of them take a step, then
        half as many of the best that have not ended, and so on.
        """
        descents, given = [], {**self.values, **best.place}
        for x in [places.coordinates_of(self.problem, keys, given), *places.points(self.problem, keys)]:
            place = {**best.place, **places.values_at(self.problem, keys, x, self.values)} if descents else best.place
            try:
                ((losses, factor),) = self.losses([{**self.values, **place}])
            except InputError:  # a value that the renderer rejects
                continue
            descents.append(_Descent(x, _Compared(place, factor, losses)))
        waiting, ended = [*descents[:1], *sorted(descents[1:], key=_Descent.total)], []
        number = _descents(self.problem, keys)
        while number:
            chosen, waiting = waiting[:number], waiting[number:]
            for each in chosen:
                after = self._stepped(keys, each)
                (ended if after is each else waiting).append(after)
            waiting.sort(key=_Descent.total)
            number //= 2
        return [each.at for each in sorted([*waiting, *ended], key=_Descent.total)[:_JUDGED]]

    def _stepped(self, keys: Sequence[str], descent: _Descent) -> _Descent:
        """Return the place after a step of least squares; the same place if no step lowers the loss."""
        problem, pictures, x, at = self.problem, self.pictures, descent.x, descent.at

        def moved(point: np.ndarray) -> dict[str, np.ndarray]:
            return {**at.place, **places.values_at(problem, keys, point, self.values)}

        def images(place: Mapping[str, np.ndarray], factor: float = at.factor) -> np.ndarray:
            lights = {key: factor * self.values[key] for key in self.lights}
            return np.concatenate(pictures.images({**self.values, **place, **lights}), axis=1)

        try:
            image, columns = images(at.place), []
            for change in np.where(x < 0.5, _DIFFERENCE, -_DIFFERENCE) * np.eye(x.size):
                columns.append((images(moved(x + change)) - image) / change.sum())
            if self.lights:  # their factor is fitted at the end of the step
                columns.append(images(at.place, 2.0 * at.factor) - image)
            halves = [np.stack([column[half::2].mean(axis=0) for column in columns]) for half in (0, 1)]
            missing = [pictures.references - image[half::2].mean(axis=0) for half in (0, 1)]
            matrix, vector = normal_equations(halves, missing, pictures.weights[:, None])
            damped = matrix + _DAMPING * np.diag(np.abs(np.diag(matrix)))
            step = np.linalg.lstsq(damped, vector)[0][: x.size]
            step *= min(1.0, _LONGEST / np.abs(step).max())
            for share in (1.0, _SHORTER):
                point = np.clip(x + share * step, 0.0, 1.0)
                after = self.compared(replace(at, place=moved(point)))
                if after.total < at.total:
                    return _Descent(point, after)
        except (InputError, np.linalg.LinAlgError):  # a value that the renderer rejects
            pass
        return descent

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
    states = [values]
    for key in keys:
        own, distance = values[key], 1.0 if known[key].angle else known[key].length
        for change in distance * np.concatenate([np.eye(own.size), -np.eye(own.size)]):
            moved = problem.unknowns[key].project(own + change.reshape(own.shape))
            states.append({**values, key: np.asarray(moved, np.float32)})
    first, *others = (pictures.losses(images) for images in pictures.images_of(states, keys))
    worse = 0
    for other in others:
        rise = difference(first, other, sampled=pictures.sampled)
        clear = rise.value > _ERRORS * rise.standard_error
        worse += clear and mean_and_error(first)[0] < _BETTER * mean_and_error(other)[0]
    return 2 * worse >= len(others) > 0


def number_of_places(problem: Problem, keys: Sequence[str]) -> int:
    """Return how many of the pictures `better_place` renders at most, without those of lights. It judges few others."""
    total = 0
    for group in places.groups(problem, keys):
        points = places.points(problem, group)
        if places.has_scale(problem, group):
            total += len(points) + 2 * _descents(problem, group) * (points.shape[1] + 3)
        else:
            total += len(points) + _NEAR * places.is_shape(problem, group[0])
    return total


def _descents(problem: Problem, keys: Sequence[str]) -> int:
    known = problem.renderer.parameters()
    return _OF_MEDIA if any(known[key].scattering == "medium" for key in keys) else _DESCENTS


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
