"""Detection of parameters that the images do not determine."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from unrender.core import timing
from unrender.core.errors import InputError
from unrender.core.text import listed, names_in
from unrender.estimators.fresh_pictures import Residuals
from unrender.runs.image_sensitivity import MAP_AXES, seen_cells, seen_elements, shown_elsewhere
from unrender.runs.numbers import MOST_ELEMENTS, TOO_SHORT
from unrender.runs.result import Result
from unrender.runs.verification import LOST, Misfit, compares
from unrender.scene.bounds import project
from unrender.scene.problem import Problem
from unrender.scene.render import power_of_two, render, selected_views

_LEAST = 0.005
"""Relative change of the images below which a parameter counts as undetermined over its range."""
_FACTOR = 1.25
"""Factor by which emitters become brighter and reflectances darker."""
_LEAST_OF_FACTOR = 0.1
"""Fraction of the change by brighter emitters that must remain with darker reflectances, if the images distinguish the two."""
_KNOWN = 0.1
"""Standard error, relative to the largest value of a parameter, below which its factor is known."""
_OF_RANGE = 0.25
"""Standard error, relative to the range of a parameter, below which the parameter is determined however little it changes the images."""
_ERRORS = 2.0
"""Number of standard errors by which a change must be below its limit."""
_MOVED = 0.1
"""Root mean square change from the initial values, relative to the values, from which recovered values may be noise."""
_UNSEEN = 0.05
"""Fraction of unseen cells of a texture or grid from which a line is returned."""
_SCALE = "scale"
"""Last part of the keys of factors, such as that of an environment map."""
_ROLES = ("value", "height")
"""Roles of the tested parameters; equal normals or directions are no range."""
_STEP = 0.1
"""Change of the parameters, relative to the range between their bounds, or to the root mean square of their values or size of a pose."""
_GONE, _OF_LOST = 0.1, 0.25
"""Change of the images up to which an unknown is no longer seen, and least difference from the references if it is lost, both relative to
the change from its start to its end."""
_SEEDS, _RENDERINGS = (3, 4), 8
"""Seeds of the two independent halves, and number of renderings per view for two changes."""


@dataclass(frozen=True)
class Change:
    """Change of images as mean squares over pixels and channels: without rendering noise (may be negative), its standard error, and that of
    the images."""

    square: float
    error: float
    scale: float

    def is_below(self, share: float, scale: float | None = None) -> bool:
        """Return whether the change is significantly less than `share` of the root mean square of the images, or of √`scale`."""
        return self.square + _ERRORS * self.error < share**2 * (self.scale if scale is None else scale)

    def is_above(self, share: float) -> bool:
        """Return whether the change is significantly more than `share` of the root mean square of the images."""
        return self.square - _ERRORS * self.error > share**2 * self.scale


def undetermined(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    spp: int,
    seconds: float = np.inf,
    per_pass: int | None = None,
    most: float = 0.0,
    sensitivities: Mapping[str, np.ndarray] = MappingProxyType({}),
    errors: Mapping[str, np.ndarray] = MappingProxyType({}),
    path_seconds: float = 0.0,
) -> list[str]:
    """Return a line for each parameter that hardly changes the images over its entire range, or, without one, from its initial values.

    Parameters without a range are tested if their values have moved far, and have no standard errors; others unless these are small. Those
    of materials and media are tested while time remains, first those whose sensitivity is 0. All elements of a parameter change together.
    If a map such as a bump map hardly changes the images then, its details are tested: a checkerboard of its bounds, or its own values if
    it has none. If they change the images, only differences of its elements are determined. A map without bounds gets no other line.

    Args:
        values: {key: array}, values of the other parameters.
        spp: samples per pixel of each of four renderings per view.
        seconds: time after which no further parameter is tested; the first one always is, unless `path_seconds` says how long it takes.
        per_pass: see `render`.
        most: time limit for parameters whose sensitivity is 0, if it is longer than `seconds`.
        sensitivities: {key: array}, see `unrender.runs.sensitivity`.
        errors: {key: array}, standard errors of the values.
        path_seconds: time of a path; 0 if unknown.
    """
    known, lines, began = problem.renderer.parameters(), [], timing.now()
    unseen = {key for key, sensitivity in sensitivities.items() if not sensitivity.any()}
    until = {True: began + max(seconds, most), False: began + seconds}
    spp, longest = affordable(problem, spp, seconds, per_pass or spp, path_seconds) if path_seconds else (spp, 0.0)
    for key in sorted(problem.unknowns, key=lambda key: key not in unseen):
        info, (low, high) = known[key], problem.unknowns[key].bounds
        own, initial = np.asarray(values[key], np.float32), problem.unknowns[key].initial
        is_map, bounded = own.ndim >= MAP_AXES, low is not None or high is not None
        if is_map and not bounded:
            low, high = float(own.min()), float(own.max())
        span = None if low is None or high is None or info.role not in _ROLES else high - low
        ranged = span is not None and float(np.max(errors.get(key, span))) >= _OF_RANGE * span
        if info.rigid or info.viewpoint or info.welded or not (ranged or (key not in errors and _moved(initial, own))):
            continue
        started = timing.now()
        if longest > 0.0 and started + longest > until[key in unseen]:
            break
        ends = [project(np.full_like(own, x), low, high) for x in (low, high)] if ranged else [own, initial]
        details = np.where(np.indices(own.shape).sum(axis=0) % 2, *ends) if bounded else own
        first, last, detailed = ({**values, key: array} for array in (*ends, details))
        try:
            change = change_of_images(problem, first, last, spp, per_pass)
            of_all = sensitivities.get(key), np.subtract(*ends), _LEAST * math.sqrt(change.scale)
            hidden = change.is_below(_LEAST) and not shown_elsewhere(problem, *of_all)
            if hidden and is_map and ranged:
                change = change_of_images(problem, first, detailed, spp, per_pass)
        except InputError:  # the renderer rejects a value at the end of the range
            continue
        longest = max(longest, timing.now() - started)
        if line := _words(hidden, change, ranged, bounded):
            lines.append(f"{key}: {line}")
    return lines


def affordable(problem: Problem, spp: int, seconds: float, least: int, path_seconds: float) -> tuple[int, float]:
    """Return the samples per pixel for which there is time, from `least` to `spp`, and the time of a change of the images with these."""
    paths = _RENDERINGS / 2 * sum(math.prod(problem.sizes[view]) for view in selected_views(problem))
    spp = max(min(spp, power_of_two(int(seconds / (path_seconds * paths)))), min(least, spp))
    return spp, spp * paths * path_seconds


def _moved(initial: np.ndarray, values: np.ndarray) -> bool:
    return bool(np.linalg.norm(values - initial) > _MOVED * np.linalg.norm(values))


def _words(hidden: bool, change: Change, ranged: bool, bounded: bool) -> str:
    """Return what a change from one end of a range to the other, or to the initial values, tells of a parameter; "" for nothing."""
    less = f"by less than {_LEAST:.1%}"
    if not hidden:
        return ""
    if not ranged:
        return f"with its initial values, the pictures change {less}; its recovered values may be noise"
    if change.is_above(_LEAST):
        return f"a constant added to all of it changes the pictures {less}; only differences of its elements are determined"
    if bounded and change.is_below(_LEAST):
        return f"over its entire range the pictures change {less}; its value is the initial one, or noise"
    return ""


def undetermined_cells(sensitivities: Mapping[str, np.ndarray]) -> list[str]:
    """Return a line for each texture, grid or long list with a notable part that hardly changes the images."""
    lines = []
    for key, sensitivity in sensitivities.items():
        is_long = sensitivity.ndim == 1 and sensitivity.size > MOST_ELEMENTS  # least squares test others one by one
        where = seen_elements(sensitivity) if is_long else seen_cells(sensitivity)
        if where is not None and (share := 1.0 - float(where.mean())) >= _UNSEEN:
            lines.append(
                f"{key}: {share:.0%} of it hardly changes the pictures; values there are the initial ones, smoothed, or noise"
            )
    return lines


def untested_cells(problem: Problem) -> list[str]:
    """Return a line for all textures, grids and long lists with path gradients: that the run was too short for `undetermined_cells`."""
    known, shapes = problem.renderer.parameters(), problem.shapes()
    large = [key for key, shape in shapes.items() if len(shape) >= MAP_AXES or math.prod(shape) > MOST_ELEMENTS]
    keys = [key for key in large if known[key].differentiable and not known[key].rigid]
    return [f"whether the pictures show all of {listed(keys)}: {TOO_SHORT}"] if keys else []


def common_factor(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    spp: int,
    seconds: float = np.inf,
    per_pass: int | None = None,
    most: float = 0.0,
) -> list[str]:
    """Return a line for parameters that the images determine only up to a common factor, or for which that was not tested.

    Emitters become brighter by a factor, and reflectances darker by the same factor. The images distinguish the two if they change. The
    same test follows for a scale and the values that it multiplies, such as those of an environment map.

    Args:
        values: {key: array}, parameters at which it is tested.
        spp: most samples per pixel of each of eight renderings per view and test.
        seconds: time limit, from which the samples follow.
        per_pass: least samples per pixel; see `render`.
        most: time limit with the least samples, if it is longer than `seconds`.
    """
    tests = _products(problem)
    if not tests:
        return []
    least, started = min(per_pass or spp, spp), timing.now()
    render(problem, values, 0, least, _SEEDS[0], per_pass)
    needed = len(tests) * _RENDERINGS * len(selected_views(problem)) * (timing.now() - started)
    if needed > max(seconds, most):
        return untested_factor(problem)
    spp = max(least, power_of_two(int(min(spp, least * seconds / needed))))
    shared = [(up, down) for up, down in tests if _is_shared(problem, values, up, down, spp, per_pass)]
    return [
        f"{_both(up, down)}: determined up to a common factor only{_after(problem, values, up, down)}"
        for up, down in shared
    ]


def without_known(
    lines: Sequence[str], values: Mapping[str, np.ndarray], errors: Mapping[str, np.ndarray]
) -> list[str]:
    """Return lines of `common_factor` without those of which all parameters have small standard errors {key: array}."""
    known = {key for key, x in errors.items() if (x < _KNOWN * np.abs(values[key]).max()).all()}
    return [line for line in lines if names_in(line, values) - known]


def _is_shared(
    problem: Problem, values: Mapping[str, np.ndarray], up: list[str], down: list[str], spp: int, per_pass: int | None
) -> bool:
    """Return whether the images change by `up` times a factor, but not if `down` is divided by it."""
    larger = {key: x * np.float32(_FACTOR) if key in up else x for key, x in values.items()}
    smaller = {key: x / np.float32(_FACTOR) if key in down else x for key, x in larger.items()}
    alone = change_of_images(problem, values, larger, spp, per_pass)
    together = change_of_images(problem, values, smaller, spp, per_pass)
    return alone.square > 0.0 and together.is_below(_LEAST_OF_FACTOR, alone.square)


def _after(problem: Problem, values: Mapping[str, np.ndarray], lights: list[str], colours: list[str]) -> str:
    """Return the errors of lights and reflectances without their common factor; "" if the truth is unknown, or for a scale."""
    ratios = [np.log(factor) for key in lights if (factor := _factor(problem, key, values[key])) is not None]
    if not ratios or problem.renderer.parameters()[colours[0]].brightness != "reflectance":
        return ""
    factor = float(np.exp(np.mean(ratios)))
    after = {key: values[key] / factor if key in lights else values[key] * factor for key in (*lights, *colours)}
    errors = {
        key: problem.unknowns[key].measure.error(np.asarray(x), truth)
        for key, x in after.items()
        if (truth := problem.unknowns[key].truth) is not None
    }
    error_list = listed([f"{key} {error:.3g}" for key, error in errors.items() if error is not None])
    return f"; with lights divided by {factor:.3g} and reflectances multiplied by it, errors are {error_list}"


def untested_factor(problem: Problem) -> list[str]:
    """Return a line for parameters that may share a factor: that the run was too short for `common_factor`."""
    return [f"whether {_both(up, down)} share a factor: {TOO_SHORT}" for up, down in _products(problem)]


def _both(up: list[str], down: list[str]) -> str:
    return f"{listed(up)} and {listed(down)}"


def _products(problem: Problem) -> list[tuple[list[str], list[str]]]:
    """Return pairs of keys whose products the images may show alone: lights and reflectances; a scale and values of the same object."""
    known = problem.renderer.parameters()
    lights, colours = (
        [key for key in problem.unknowns if known[key].brightness == kind] for kind in ("light", "reflectance")
    )
    products = [(lights, colours)] if lights and colours else []
    for key in problem.unknowns:
        owner, _, name = key.rpartition(".")
        others = [k for k in problem.unknowns if k != key and k.startswith(f"{owner}.") and known[k].role in _ROLES]
        products += [([key], [other]) for other in others if name == _SCALE and not known[other].rigid]
    return products


def _factor(problem: Problem, key: str, values: np.ndarray) -> float | None:
    """Return the mean factor by which values are too large; None if the truth is unknown or 0."""
    truth = problem.truth.get(key)
    if truth is None or truth.shape != values.shape or not np.mean(truth) > 0 or not np.mean(values) > 0:
        return None
    return float(np.mean(values) / np.mean(truth))


def change_of_images(
    problem: Problem, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray], spp: int, per_pass: int | None
) -> Change:
    """Return the change between two states.

    The product of two independent differences has no noise bias; each uses equal random numbers. Pixels have the weights of the masks.
    """
    products, squares, weights = [], [], []
    for view in selected_views(problem):
        differences, own = [], problem.test_weights(view)
        for seed in _SEEDS:
            first, second = (render(problem, state, view, spp, seed, per_pass) for state in (before, after))
            seen = np.where(own[..., None] > 0, problem.units[view], 0.0)
            first, second = (np.where(seen > 0, x * seen, 0.0).astype(np.float64) for x in (first, second))
            differences.append(second - first)
            squares.append(np.sum(own * np.mean(np.square(first), axis=-1)) / len(_SEEDS))
        products.append((own * np.mean(differences[0] * differences[1], axis=-1)).reshape(-1))
        weights.append(float(np.sum(own)))
    flat, total = np.concatenate(products), max(sum(weights), 1e-300)
    return Change(
        float(flat.sum() / total), float(flat.std() * np.sqrt(flat.size) / total), float(np.sum(squares) / total)
    )


def with_lost(
    problem: Problem,
    result: Result,
    difference: Misfit | None,
    keys: Sequence[str],
    ends: Sequence[Sequence[np.ndarray]],
    per_pass: int,
    remaining: Callable[[], float] = lambda: math.inf,
) -> Misfit | None:
    """Return the difference of the final pictures from the references with the cause that unknowns are lost, if so.

    The pictures show these unknowns at the start, but no longer at the end, such as a shape outside of the picture. They then differ from
    the references by a notable part of what the unknown changes.

    Args:
        difference: difference that is known.
        keys: unknowns that the pictures of the end do not determine.
        ends: K >= 2 independent pictures (H, W, 3) of each view at the end.
        per_pass: samples per pixel of each of the four passes of an image.
        remaining: function that returns the remaining seconds. The test ends before an unknown for which they do not suffice.
    """
    remeshed = problem.remeshed_from is not None  # the initial values are then those of another mesh
    if not keys or remeshed or len(ends[0]) < 2 or not compares(problem) or result.verification.get("best") != "end":
        return difference
    residuals = Residuals.of(problem, range(len(ends)), ends)
    left = residuals.shared
    start, end, lost, longest, spp = result.initial, result.parameters, [], 0.0, 4 * per_pass
    for key in keys:
        if remaining() <= longest:
            break
        began, path = timing.now(), np.asarray(end[key], np.float64) - start[key]
        away = np.where(path < 0.0, -1.0, 1.0)  # a step towards the start might end there
        near = {**end, key: changed(problem, key, end[key], away, least=_root_mean_square(path))}
        try:
            seen = change_of_images(problem, start, {**start, key: end[key]}, spp, per_pass)
            if seen.is_above(_LEAST) and left > _OF_LOST**2 * seen.square:
                hidden = change_of_images(problem, end, near, spp, per_pass).is_below(_GONE, seen.square)
                lost += [key] * hidden
        except InputError:  # the renderer rejects a value
            continue
        longest = max(longest, timing.now() - began)
    if not lost:
        return difference
    explanation = (
        f", and the pictures no longer depend on {listed(lost)} as they did at the start: try narrower bounds, a lower learning_rate, or a "
        "start closer to the references"
    )
    difference = difference or Misfit(math.sqrt(left), residuals.size, 0.0)
    return replace(difference, explanation=explanation, causes=(LOST,))


def changed(problem: Problem, key: str, values: np.ndarray, signs: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Return values changed by a step times numbers in [-1, 1], whose signs turn where the step would leave the bounds.

    `least` is the smallest step of unknowns without bounds. That of poses is at least 0.1 radians, or 0.1 lengths of the object.
    """
    (low, high), info = problem.unknowns[key].bounds, problem.renderer.parameters()[key]
    smallest = (1.0 if info.angle else info.length) if info.rigid else 0.0
    size = max(_root_mean_square(values), smallest) or 1.0
    step = signs * (max(_STEP * size, least) if low is None or high is None else _STEP * (high - low))
    outside = values + step != np.asarray(problem.unknowns[key].project(values + step))
    return np.asarray(problem.unknowns[key].project(values + np.where(outside, -step, step)), np.float32)


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
