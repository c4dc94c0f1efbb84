"""Least squares at the end of a run: which of a few numbers the references do not determine, and which had not arrived."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.random import Key
from unrender.core.text import listed
from unrender.display import formatting
from unrender.rendering.renderer import RenderSession, SampleRequest
from unrender.scene.problem import Problem
from unrender.scene.render import power_of_two

__all__ = ["NumbersCheck", "check_numbers", "compile_check"]

_MOST_ELEMENTS, _MOST_OF_ONE = 24, 4
"""Elements of all numbers and of one, up to which they are tested."""
_MOST_VALUES = 1 << 25
"""Values of the pictures of one pass, up to which there is a check."""
_MOST_VIEWS = 4
_PATHS, _SPP = 1 << 18, (4, 32)
"""Path budget of the pictures of one pass, and limits of their samples per pixel."""
_STREAM = 4
_PASSES, _CHANGES = 3, (64.0, 8.0, 4.0)
"""Passes that find widths, and the factors by which these change at most."""
_SHIFT = 0.3
"""Shift of the picture, in pixels, that a difference is as large as."""
_WEAKEST = 1e-4
"""Smallest eigenvalue, relative to the largest, that the length of a direction follows."""
_REPEATS = 8
"""Most repeats of the pictures that are judged."""
_ERRORS = 3.0
"""Standard errors by which the change along a direction must exceed its noise."""
_DOUBTFUL = 0.1
"""Standard error, as a share of a number's size, from which on the references leave it open."""
_FURTHER, _STEP_ERRORS = 0.05, 4.0
"""Least remaining step, as a share of a number's size and in standard errors, that is reported."""
_OF_WIDTHS = 10.0
"""Size of a pose, in widths of its differences: it may be 0 at the end."""
_TOGETHER = 0.9
"""Correlation from which on two numbers count as determined together."""


@dataclass(frozen=True)
class NumbersCheck:
    """Result of the least-squares test of the numbers of a run.

    Attributes:
        undetermined: {key: line} of the numbers that the references leave open.
        unfinished: {key: line} of those that a least-squares step would still move.
        errors: {key: standard errors} of all numbers, the references' noise included.
        steps: {key: least-squares steps} of all numbers.
    """

    undetermined: Mapping[str, str] = field(default_factory=dict)
    unfinished: Mapping[str, str] = field(default_factory=dict)
    errors: Mapping[str, np.ndarray] = field(default_factory=dict)
    steps: Mapping[str, np.ndarray] = field(default_factory=dict)


@exclusive("check_numbers")
def check_numbers(
    problem: Problem, values: Mapping[str, np.ndarray], start: Mapping[str, np.ndarray], seconds: float
) -> NumbersCheck:
    """Return what least squares at `values` says about the problem's numbers, with all other unknowns fixed.

    The derivatives J of the pictures are differences of renders, along directions of which the pictures change independently. The
    covariance of the numbers is (JᵀJ)⁻¹ Jᵀ diag(r²) J (JᵀJ)⁻¹, with the residual r after the step below. It contains the references' noise.
    If it is large relative to the numbers, the references do not determine them. Where the step −(JᵀJ)⁻¹ Jᵀ r is long, the run ended early.

    Numbers with a prior are fixed, too. Steps are reported for losses with a linear derivative only: others have their minimum elsewhere.

    Args:
        problem: problem with views and scene.
        values: {key: array} at the end.
        start: {key: array} at the start.
        seconds: time after which nothing further is started; there is no result then.
    """
    numbers = _Numbers.of(problem, values, start)
    if numbers is None:
        return NumbersCheck()
    until = time.perf_counter() + seconds
    try:
        return _check(numbers, until)
    except (
        InputError,
        np.linalg.LinAlgError,
    ):  # a value that the renderer rejects, or matrices without eigenvalues in double precision
        return NumbersCheck()


@exclusive("compile_check")
def compile_check(problem: Problem, values: Mapping[str, np.ndarray]) -> None:
    """Compile the kernels of `check_numbers`."""
    if (numbers := _Numbers.of(problem, values, values)) is not None:
        with contextlib.suppress(InputError):  # a value that the renderer rejects
            for count in (1, 2 * numbers.point.size):
                numbers.pictures(np.tile(numbers.point, (count, 1)), Key(0, 0, _STREAM))


@dataclass(frozen=True)
class _Differences:
    """Differences of pictures along K directions.

    Attributes:
        directions: half of the differences of parameters, (n, K).
        one, other: halves of the pictures' differences, independent of each other, (K, P, 3) with roots of the pixels' weights.
    """

    directions: np.ndarray
    one: np.ndarray
    other: np.ndarray

    def squares(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums of squares over pixels and channels without noise, and their standard errors, (K,) each."""
        products = (self.one * self.other).sum(axis=2)
        return products.sum(axis=1), products.std(axis=1) * math.sqrt(products.shape[1])

    def matrix(self) -> np.ndarray:
        """Return the products of all pairs of differences without noise, (K, K)."""
        product = self.one.reshape(len(self.one), -1) @ self.other.reshape(len(self.other), -1).T
        return 0.5 * (product + product.T)

    def mean(self, other: _Differences, number: int) -> _Differences:
        """Return the mean of these `number` differences and one more along the same directions."""
        share = 1.0 / (number + 1.0)
        one, two = (a + share * (b - a) for a, b in ((self.one, other.one), (self.other, other.other)))
        return _Differences(self.directions, one, two)


@dataclass(frozen=True)
class _Numbers:
    """The numbers of a problem, at a point.

    Attributes:
        problem: theirs.
        values: {key: array} of all unknowns.
        keys: of the numbers.
        views: that are rendered.
        point: the numbers, (n,).
        sizes: of the numbers, by which changes are judged, (n,); 0 where nothing is known.
        limits: longest difference of each, (n,).
        rigid: which are of poses, (n,).
        spp: samples per pixel of a picture.
    """

    problem: Problem
    values: Mapping[str, np.ndarray]
    keys: tuple[str, ...]
    views: tuple[int, ...]
    point: np.ndarray
    sizes: np.ndarray
    limits: np.ndarray
    rigid: np.ndarray
    spp: int

    @classmethod
    def of(cls, problem: Problem, values: Mapping[str, np.ndarray], start: Mapping[str, np.ndarray]) -> _Numbers | None:
        known, count = problem.renderer.parameters(), len(problem.views)
        views = sorted({round(place) for place in np.linspace(0, count - 1, min(count, _MOST_VIEWS))})
        sensors = {problem.views[view].sensor for view in views}
        keys = [
            key
            for key, x in values.items()
            if x.ndim <= 1
            and x.size <= _MOST_OF_ONE
            and known[key].perturbable
            and problem.unknowns[key].prior is None
            and (known[key].sensor is None or known[key].sensor in sensors)
        ]
        elements = sum(values[key].size for key in keys)
        pixels = sum(math.prod(problem.sizes[view]) for view in views)
        if not keys or elements > _MOST_ELEMENTS or 6 * elements * pixels > _MOST_VALUES:
            return None
        sizes, limits = [], []
        for key in keys:
            low, high = problem.unknowns[key].bounds
            size = max(float(np.abs(x[key]).max()) for x in (values, start))
            limit = 0.5 * (size or 1.0)
            if known[key].rigid:
                limit = max(0.5, limit)
            elif low is not None and high is not None:
                size, limit = min(size, high - low), 0.25 * (high - low)
            elif low is not None:  # positive without an end: what counts is the ratio
                size = float(np.abs(values[key]).max()) or size
                limit = 0.5 * size
            sizes += [size] * values[key].size
            limits += [limit] * values[key].size
        rigid = np.concatenate([np.full(values[key].size, known[key].rigid) for key in keys])
        spp = min(max(_PATHS // (2 * elements * pixels), _SPP[0]), _SPP[1])
        point = np.concatenate([np.ravel(values[key]).astype(np.float64) for key in keys])
        return cls(
            problem, values, tuple(keys), tuple(views), point, np.array(sizes), np.array(limits), rigid,
            power_of_two(spp),
        )  # fmt: skip

    def parts(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Return the numbers by key, (B, *shape), from (B, n)."""
        return {k: points[:, of].reshape(len(points), *self.values[k].shape) for k, of in self.places().items()}

    def places(self) -> dict[str, slice]:
        """Return where the numbers of each key are."""
        ends = np.cumsum([self.values[key].size for key in self.keys])
        return {
            key: slice(int(end) - self.values[key].size, int(end)) for key, end in zip(self.keys, ends, strict=True)
        }

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return the points (B, n) within the bounds."""
        parts = {key: self.problem.unknowns[key].project(x) for key, x in self.parts(points).items()}
        return np.concatenate([x.reshape(len(points), -1) for x in parts.values()], axis=1).astype(np.float32)

    def pictures(self, points: np.ndarray, key: Key) -> np.ndarray:
        """Return the pictures (B, P, 3) of all views at points (B, n), from the same random numbers."""
        count = len(points)
        batch = {k: np.broadcast_to(x, (count, *x.shape)) for k, x in self.values.items()}
        batch.update({k: x.astype(np.float32) for k, x in self.parts(points).items()})
        session: RenderSession = self.problem.renderer.prepare(list(batch), None, derivatives=False)
        parts = []
        for view in self.views:
            request = SampleRequest(self.problem.views[view].sensor, self.spp, key.fold(view).uint32())
            images = arrays.numpy(session.image_batch(batch, request)).astype(np.float64)
            parts.append(images.reshape(count, -1, 3) * self._roots(view))
        return np.concatenate(parts, axis=1)

    def references(self) -> np.ndarray:
        """Return the references (P, 3) with the roots of the pixels' weights."""
        of = [self.problem.views[view].reference for view in self.views]
        flat = [np.asarray(x, np.float64).reshape(-1, 3) * self._roots(v) for x, v in zip(of, self.views, strict=True)]
        return np.concatenate(flat)

    def _roots(self, view: int) -> np.ndarray:
        """Return the roots of the weights of a view's pixels, (P, 1)."""
        mask, (height, width) = self.problem.views[view].mask, self.problem.sizes[view]
        weights = np.ones(height * width) if mask is None else np.asarray(mask, np.float64).reshape(-1)
        return np.sqrt(weights * self.problem.views[view].weight)[:, None]

    def differences(self, directions: np.ndarray, key: Key) -> _Differences:
        """Return the differences along directions (n, K) of some length."""
        count = directions.shape[1]
        ends = self.inside(np.concatenate([self.point + directions.T, self.point - directions.T]))
        halves = [self.pictures(ends, key.fold(half)) for half in (0, 1)]
        one, other = (0.5 * (half[:count] - half[count:]) for half in halves)
        return _Differences(0.5 * (ends[:count] - ends[count:]).T.astype(np.float64), one, other)

    def slope(self) -> float:
        """Return the root mean square of the references' differences of neighbouring pixels, or 1 % of the references."""
        squares, total = 0.0, 0
        for view in self.views:
            image = np.asarray(self.problem.views[view].reference, np.float64)
            squares += 0.5 * sum(float(np.square(np.diff(image, axis=axis)).sum()) for axis in (0, 1))
            total += image.size
        least = 0.01 * math.sqrt(float(np.mean(np.square(self.references()))))
        return max(math.sqrt(squares / total), least, 1e-30)


def _check(numbers: _Numbers, until: float) -> NumbersCheck:
    """Return the lines, or none where there is no time."""
    key, change = Key(0, 0, _STREAM), _SHIFT * numbers.slope()
    widths, longest = 0.01 * np.where(numbers.sizes > 0.0, numbers.sizes, 1.0), 0.0
    for index in range(_PASSES + 1):
        started = time.perf_counter()
        if started + longest > until:
            return NumbersCheck()
        differences = numbers.differences(np.diag(widths), key.fold(index))
        longest = time.perf_counter() - started
        if index < _PASSES:
            squares, errors = differences.squares()
            changes = np.sqrt(np.maximum(squares, errors) / differences.one[0].size)
            factors = np.clip(change / np.maximum(changes, 1e-30), 1.0 / _CHANGES[index], _CHANGES[index])
            widths = np.minimum(factors * widths, numbers.limits)
    matrix = differences.matrix()
    if not (np.isfinite(matrix).all() and matrix.any()):
        return NumbersCheck()  # pictures that are not finite, or that no number changes
    directions, repeats = _directions(differences, numbers.limits, change), 0
    residuals = np.zeros((2, *numbers.references().shape))
    while repeats < _REPEATS and (not repeats or time.perf_counter() + 2.0 * longest < until):
        own = key.fold(_PASSES + 1 + repeats)
        more = numbers.differences(directions, own)
        differences = more if repeats == 0 else differences.mean(more, repeats)
        for half in (0, 1):  # as many pictures as for the differences
            for index in range(len(widths)):
                picture = numbers.pictures(numbers.point[None], own.fold(2 + 2 * index + half))[0]
                residuals[half] += picture - numbers.references()
        repeats += 1
    return _judged(numbers, differences, residuals / (repeats * len(widths)), widths)


def _directions(differences: _Differences, limits: np.ndarray, change: float) -> np.ndarray:
    """Return directions (n, n) along which the pictures change independently and by `change`, within the limits."""
    matrix = differences.matrix()
    units = np.sqrt(np.maximum(np.diag(matrix), 1e-12 * np.abs(matrix).max())) + 1e-300
    eigenvalues, vectors = np.linalg.eigh(matrix / np.outer(units, units))
    lengths = (
        change * math.sqrt(differences.one[0].size) / np.sqrt(np.maximum(eigenvalues, _WEAKEST * eigenvalues.max()))
    )
    columns = differences.directions @ (vectors * lengths / units[:, None])
    return columns / np.maximum(np.max(np.abs(columns) / limits[:, None], axis=0), 1.0)


def _judged(numbers: _Numbers, differences: _Differences, residuals: np.ndarray, widths: np.ndarray) -> NumbersCheck:
    """Return the lines from differences along directions and two independent residuals (2, P, 3)."""
    matrix, (squares, errors) = differences.matrix(), differences.squares()
    # Along these no change is seen: the variance is at least that of the largest change that noise may hide.
    hidden = squares <= _ERRORS * errors
    matrix[hidden, :] = matrix[:, hidden] = 0.0
    least = 1e-12 * float(np.abs(squares).max()) + 1e-200
    np.fill_diagonal(matrix, np.where(hidden, np.maximum(squares, 0.0) + _ERRORS * errors + least, np.diag(matrix)))
    units = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.pinv(matrix / np.outer(units, units), rcond=1e-6, hermitian=True) / np.outer(units, units)
    slopes = 0.5 * (differences.one + differences.other).reshape(len(units), -1)
    residual, noise = (0.5 * (residuals[0] + sign * residuals[1]).reshape(-1) for sign in (1.0, -1.0))
    share = math.sqrt(len(numbers.views) / len(numbers.problem.views))

    def covariance(of: np.ndarray) -> np.ndarray:
        middle = (slopes * of**2) @ slopes.T
        middle[hidden, :] = middle[:, hidden] = 0.0
        middle += np.diag(np.where(hidden, np.mean(of**2) * units**2, 0.0))
        return share**2 * (differences.directions @ inverse @ middle @ inverse @ differences.directions.T)

    along = -inverse @ np.where(hidden, 0.0, slopes @ residual)
    step_covariance = covariance(residual + along @ slopes)  # as after the step: a run that ended early leaves more
    error, own = (np.sqrt(np.maximum(np.diag(x), 0.0)) for x in (step_covariance, covariance(noise)))
    spread = np.outer(error, error)
    freedom = residual.size - error.size
    error = error * math.sqrt(residual.size / freedom) if freedom > 0 else np.full(error.size, np.inf)
    step = numbers.inside((numbers.point + differences.directions @ along)[None])[0] - numbers.point
    posed = numbers.rigid | (numbers.sizes <= 0.0)
    sizes = np.where(posed, np.maximum(numbers.sizes, _OF_WIDTHS * widths), numbers.sizes)
    open_, together = error > _DOUBTFUL * sizes, np.abs(step_covariance) > _TOGETHER * spread
    further = np.abs(step) > np.maximum(_STEP_ERRORS * np.maximum(error, own), _FURTHER * sizes)
    shown, more = np.minimum(error, sizes), np.where(error > sizes, " or more", "")
    undetermined, unfinished = {}, {}
    for key, of in numbers.places().items():
        if open_[of].any():
            others = [k for k, x in numbers.places().items() if k != key and together[of][open_[of]][:, x].any()]
            together_with = f", together with {listed(others)}" if others else ""
            undetermined[key] = (
                f"{key}: the references leave it open by ± {_numbers(shown[of])}{max(more[of])}{together_with} (standard error with their "
                "noise); fix one of these, add views, or narrow the bounds"
            )
        elif further[of].any() and numbers.problem.loss.linear:
            unfinished[key] = (
                f"{key}: the run ended before it settled: a least-squares step from its end moves it by {_numbers(step[of])}, with the "
                f"standard error {_numbers(error[of])}; give more seconds, or resume the run"
            )
    errors, steps = ({k: x[of] for k, of in numbers.places().items()} for x in (error, step))
    return NumbersCheck(undetermined, unfinished, errors, steps)


def _numbers(values: np.ndarray) -> str:
    return ", ".join(map(formatting.number, values))
