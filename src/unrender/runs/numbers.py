"""Numbers of a problem, directions of its textures and grids, picture differences along both; result of their least-squares test."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays, timing
from unrender.core.random import Key
from unrender.core.text import listed
from unrender.rendering.renderer import RenderSession, SampleRequest
from unrender.runs.image_sensitivity import ADJOINT, adjoint_spp, mask_roots
from unrender.scene.problem import Problem
from unrender.scene.render import limited_spp, power_of_two, selected_views
from unrender.statistics.paired_losses import slices_of_images

MOST_ELEMENTS, _MOST_OF_ONE = 24, 4
"""Elements of all numbers up to which they are tested; elements of a number or colour; longer lists are left out first."""
_MOST_VALUES = 1 << 25
"""Values of the pictures of one pass, up to which there is a check."""
_PATHS, _LEAST_PATHS, _SPP = 1 << 18, 1 << 11, (4, 32)
"""Path budget of the pictures of one pass, least paths of one picture in a short run, and limits of their samples per pixel."""
ERRORS, _ROUNDING = 3.0, 1e-10
"""Standard errors by which a change must exceed its noise; square of one, relative to the largest, that rounding leaves."""
TOO_SHORT = "the run is too short for this test; use more steps or seconds, or fewer pixels"
"""Reason of a test that takes more than its share of the run's time."""


@dataclass(frozen=True)
class Differences:
    """Central differences of pictures along K directions.

    Attributes:
        directions: half of the differences of numbers and factors, (n + k, K), see `Numbers`.
        one, other: half of the pictures' differences, (K, P, 3), with two independent sets of random numbers. They are multiplied by the
            roots of the pixels' weights.
    """

    directions: np.ndarray
    one: np.ndarray
    other: np.ndarray

    def squares(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums of squares over pixels and channels without noise, and their standard errors, (K,) each.

        The errors come from the difference of both halves, not from the scatter over pixels: few pixels, such as those of a visible
        lamp, may show nearly all of a change without noise. For halves s + a and s + b, a − b and a + b are independent and of one
        distribution, if noise is Gaussian. The square of (one − other) times their mean then has the variance of the product as its mean.
        """
        apart, mean = self.one - self.other, self.average()
        variances = np.square((mean * apart).sum(axis=2))
        return (self.one * self.other).sum(axis=(1, 2)), np.sqrt(variances.sum(axis=1))

    def hidden(self) -> np.ndarray:
        """Return whether the change along a direction is within its noise, (K,)."""
        squares, errors = self.squares()
        return squares <= ERRORS * errors + _ROUNDING * float(np.abs(squares).max())

    def average(self) -> np.ndarray:
        """Return the mean of both halves, (K, P, 3)."""
        return 0.5 * (self.one + self.other)

    def matrix(self) -> np.ndarray:
        """Return the products of all pairs of differences without noise, (K, K)."""
        product = self.one.reshape(len(self.one), -1) @ self.other.reshape(len(self.other), -1).T
        return 0.5 * (product + product.T)

    def weights(self) -> np.ndarray:
        """Return the inverse squares of the standard errors of `squares`, (K,)."""
        squares, errors = self.squares()
        return 1.0 / np.square(errors + 1e-6 * np.abs(squares) + 1e-100)

    def mixed(self, factors: np.ndarray) -> Differences:
        """Return the differences along sums of the directions times factors (K, L), as far as pictures are linear."""
        parts = (np.tensordot(factors.T, half, axes=1) for half in (self.one, self.other))
        return Differences(self.directions @ factors, *parts)

    def moved(self, other: Differences, share: np.ndarray) -> Differences:
        """Return these differences, moved by shares (K,) towards others along the same directions."""
        pairs = ((self.one, other.one), (self.other, other.other))
        return Differences(self.directions, *(a + share[:, None, None] * (b - a) for a, b in pairs))


@dataclass(frozen=True)
class Numbers:
    """The n numbers of a problem at a point, and the factors of k directions of its textures and grids.

    Attributes:
        values: {key: array} of all unknowns.
        views: indices of the rendered views.
        point: numbers, then the factors, which are 0, (n + k,).
        start: numbers at the start of the run, (n,).
        sizes: sizes of the numbers, to which changes are relative, (n,); 0 if a number is 0 at the start and at the end.
        limits: largest change of each in one direction, (n + k,).
        rigid: whether a number is of a pose, (n,).
        spp: samples per pixel of a picture.
        fields: {key: (k, *shape)}, directions of textures and grids.
        weights: weights of each view's pixels in addition to the views' weights, (H, W, 1) or (H, W, 3); () for equal ones.
        settled: whether the run states a small standard error of a number, (n,).
        ends: see `check_numbers`.
    """

    problem: Problem
    values: Mapping[str, np.ndarray]
    keys: tuple[str, ...]
    views: tuple[int, ...]
    point: np.ndarray
    start: np.ndarray
    sizes: np.ndarray
    limits: np.ndarray
    rigid: np.ndarray
    spp: int
    fields: Mapping[str, np.ndarray] = field(default_factory=dict)
    weights: Sequence[np.ndarray] = ()
    settled: np.ndarray | bool = False
    ends: Mapping[int, Sequence[np.ndarray]] = field(default_factory=dict)

    @classmethod
    def of(cls, problem: Problem, values: Mapping[str, np.ndarray], start: Mapping[str, np.ndarray]) -> Numbers | None:
        """Return the numbers of a problem without directions of textures and grids.

        Numbers are parameters of at most one axis that can be perturbed and have no prior: those of up to four elements, and lists as long
        as all have at most 24 elements. Parameters of sensors count only if one of the tested views shows them. The result is None if there
        are no numbers, if they have more than 24 elements, or if the pictures of a pass are too large.

        Args:
            values: {key: array} of all unknowns.
            start: {key: array}, initial values, for the sizes.
        """
        known, views = problem.renderer.parameters(), selected_views(problem)
        sensors = {problem.views[view].sensor for view in views}
        keys = [
            key
            for key, x in values.items()
            if x.ndim <= 1
            and known[key].perturbable
            and problem.unknowns[key].prior is None
            and (known[key].sensor is None or known[key].sensor in sensors)
        ]
        lists = [key for key in keys if values[key].size > _MOST_OF_ONE]
        while lists and sum(values[key].size for key in keys) > MOST_ELEMENTS:
            keys.remove(lists.pop())
        elements = sum(values[key].size for key in keys)
        pixels = sum(math.prod(problem.sizes[view]) for view in views)
        if not keys or elements > MOST_ELEMENTS or 6 * elements * pixels > _MOST_VALUES:
            return None
        sizes, limits = [], []
        for key in keys:
            low, high = problem.unknowns[key].bounds
            size = max(float(np.abs(x[key]).max()) for x in (values, start))
            limit = 0.5 * (size or known[key].length)
            if known[key].rigid:
                limit = max(0.5 * known[key].length, limit)
            elif low is not None and high is not None:
                size, limit = min(size, high - low), 0.25 * (high - low)
            elif low is not None:  # positive without an end: what counts is the ratio
                size = float(np.abs(values[key]).max()) or size
                limit = 0.5 * (size or known[key].length)
            sizes += [size] * values[key].size
            limits += [limit] * values[key].size
        rigid = np.concatenate([np.full(values[key].size, known[key].rigid) for key in keys])
        spp = limited_spp(_PATHS // (2 * elements), pixels, _SPP)
        point, began = (np.concatenate([np.ravel(x[key]).astype(np.float64) for key in keys]) for x in (values, start))
        return cls(
            problem, values, tuple(keys), tuple(views), point, began, np.array(sizes), np.array(limits), rigid,
            power_of_two(spp),
        )  # fmt: skip

    @property
    def count(self) -> int:
        """Number of elements of the numbers, n."""
        return len(self.sizes)

    def affordable(self, passes: int, seconds: float) -> Numbers | None:
        """Return numbers with as many samples, up to their own, as counted renderings allow for a check; None if there is no time for one.

        Args:
            passes: number of differences along each number before the last ones, which are along all directions.
            seconds: time limit on the clock of `timing`.
        """
        n, others = self.count, len(self.problem.unknowns) - len(self.keys)
        k = n + 1 + others if others else 0  # first directions of textures and grids
        launches = len(self.views) * (2 * passes + 4 + 2 * (n + k) + 4 * (k > 0))
        pixels = sum(math.prod(self.problem.sizes[view]) for view in self.views)
        adjoints = (1 + ADJOINT * (n + 1)) * adjoint_spp(self.problem) * self.problem.pixels if k else 0
        spp = self.spp
        while timing.cost(spp * pixels * (4 * n * passes + 8 * k + 6 * (n + k) + 2) + adjoints, launches) > seconds:
            spp //= 2
            if spp < 2 or spp * pixels < _LEAST_PATHS:
                return None
        return replace(self, spp=spp)

    def alone(self) -> Numbers:
        """Return the numbers without directions of other unknowns."""
        return replace(self, fields={}, point=self.point[: self.count], limits=self.limits[: self.count])

    def with_directions(self, fields: Mapping[str, np.ndarray]) -> Numbers:
        """Return the numbers with directions {key: (k, *shape)} of other unknowns in addition to their own."""
        added = len(next(iter(fields.values())))
        own = {key: np.concatenate([self.fields[key], w]) if key in self.fields else w for key, w in fields.items()}
        point, limits = (np.append(x, np.full(added, of)) for x, of in ((self.point, 0.0), (self.limits, 1.0)))
        return replace(self, fields=own, point=point, limits=limits)

    def parts(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Return the unknowns that points (B, n + k) change, {key: (B, *shape)}, within their bounds."""
        count, factors = len(points), points[:, self.count :]
        parts = {k: points[:, of].reshape(count, *self.values[k].shape) for k, of in self.places().items()}
        if factors.any():
            for key, directions in self.fields.items():
                parts[key] = self.values[key] + np.tensordot(factors, directions, axes=1)
        return {key: np.asarray(self.problem.unknowns[key].project(x), np.float32) for key, x in parts.items()}

    def places(self) -> dict[str, slice]:
        """Return where the numbers of each key are."""
        ends = np.cumsum([self.values[key].size for key in self.keys])
        return {
            key: slice(int(end) - self.values[key].size, int(end)) for key, end in zip(self.keys, ends, strict=True)
        }

    def tangents(self) -> np.ndarray:
        """Return the matrix (n + k, n + k) that removes changes of the lengths of directions and ratios; no picture depends on these."""
        matrix, known = np.eye(self.point.size), self.problem.renderer.parameters()
        for key, of in self.places().items():
            own = self.point[of]
            if known[key].role in ("direction", "ratios") and own.any():
                matrix[of, of] -= np.outer(own, own) / float(own @ own)
        return matrix

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return the points (B, n + k) with the numbers within their bounds."""
        own = np.zeros_like(points)
        own[:, : self.count] = points[:, : self.count]
        parts = [x.reshape(len(points), -1) for x in self.parts(own).values()]
        return np.concatenate([*parts, points[:, self.count :].astype(np.float32)], axis=1)

    def pictures(self, points: np.ndarray, key: Key) -> np.ndarray:
        """Return the pictures (B, P, 3) of all views at points (B, n + k), from the same random numbers."""
        count = len(points)
        batch = {k: np.broadcast_to(x, (count, *x.shape)) for k, x in self.values.items()} | self.parts(points)
        session: RenderSession = self.problem.renderer.prepare(list(batch), None, derivatives=False)
        parts = []
        for view in self.views:
            request = SampleRequest(self.problem.views[view].sensor, self.spp, key.fold(view).uint32())
            images = arrays.numpy(session.image_batch(batch, request)).astype(np.float64)
            parts.append(self.weighted(view, images))
            timing.add(self.spp * (images.size // 3))
        return np.concatenate(parts, axis=1)

    def residual(self, point: np.ndarray, key: Key) -> np.ndarray:
        """Return the picture (P, 3) at a point (n + k,) minus the references; 0 in pixels that are not finite."""
        residual = self.pictures(point[None], key)[0] - self.references()
        return np.where(np.isfinite(residual).all(axis=1)[:, None], residual, 0.0)

    def by_view(self, pictures: np.ndarray) -> list[np.ndarray]:
        """Return pictures (k, P, 3) of all views as (k, H, W, 3) of each view."""
        sizes = [self.problem.sizes[view] for view in self.views]
        parts = zip(slices_of_images(sizes), sizes, strict=True)
        return [pictures[:, part].reshape(len(pictures), *size, 3) for part, size in parts]

    def references(self) -> np.ndarray:
        """Return the references (P, 3) with the roots of the pixels' weights."""
        of = [np.asarray(self.problem.views[view].reference, np.float64)[None] for view in self.views]
        return np.concatenate([self.weighted(view, x)[0] for view, x in zip(self.views, of, strict=True)])

    def weighted(self, view: int, pictures: np.ndarray) -> np.ndarray:
        """Return pictures (B, H, W, 3) of a view times the roots of its pixels' weights, (B, P, 3); 0 where these are 0."""
        roots = self.roots(view)
        return np.where(roots > 0.0, pictures.reshape(len(pictures), -1, 3), 0.0) * roots

    def roots(self, view: int) -> np.ndarray:
        """Return the roots of the weights of a view's pixels, (P, 3), or (P, 1) if its channels have equal weights.

        As in the loss, a view has its weight whatever the number of its pixels.
        """
        roots = mask_roots(self.problem, view).reshape(-1, 1)
        share = self.problem.pixels / (len(self.problem.views) * len(roots))
        roots = roots * math.sqrt(share * self.problem.views[view].weight)
        return roots * np.sqrt(self.weights[view]).reshape(len(roots), -1) if self.weights else roots

    def differences(self, directions: np.ndarray, key: Key) -> Differences:
        """Return the differences of `point` ± each column of directions (n + k, K), within the bounds."""
        count = directions.shape[1]
        ends = self.inside(np.concatenate([self.point + directions.T, self.point - directions.T]))
        halves = [self.pictures(ends, key.fold(half)) for half in (0, 1)]
        one, other = (0.5 * (half[:count] - half[count:]) for half in halves)
        finite = np.reshape(np.isfinite(one + other).all(axis=(0, 2)), (-1, 1))
        if finite.mean() >= _FINITE:  # the others leave the test
            one, other = np.where(finite, one, 0.0), np.where(finite, other, 0.0)
        return Differences(0.5 * (ends[:count] - ends[count:]).T.astype(np.float64), one, other)

    def slope(self) -> float:
        """Return the root mean square of the references' differences of neighbouring pixels, or 1 % of the references.

        Differences have the root of the smaller weight of both pixels: the weights do not move with the picture.
        """
        squares, total = 0.0, 0
        for view in self.views:
            image = np.asarray(self.problem.views[view].reference, np.float64)
            roots = self.roots(view).reshape(*image.shape[:2], -1)
            for x, root in ((image, roots), (image.swapaxes(0, 1), roots.swapaxes(0, 1))):
                squares += 0.5 * float(np.square(np.diff(x, axis=0) * np.minimum(root[1:], root[:-1])).sum())
            total += image.size
        least = 0.01 * math.sqrt(float(np.mean(np.square(self.references()))))
        return max(math.sqrt(squares / total), least, 1e-30)


_FINITE = 0.99
"""Least share of pixels that are finite, for which the others leave the test."""
_CLEAR, _OWN = 3.0, 3.0
"""Length of a step over its noise from which it counts as a distance, if the run states its own error, and the check's error relative to
that from which it replaces it: the mean of models along a curved valley has a curvature that none of them has."""


@dataclass(frozen=True)
class NumbersCheck:
    """Result of the least-squares test of the numbers of a run.

    Attributes:
        undetermined: {key: line} of the numbers that the references leave open.
        unfinished: {key: line} of those that a least-squares step would still move, or whose solution is beyond a bound.
        errors: {key: standard errors} of all numbers but the unchecked ones, the references' noise included.
        steps: {key: least-squares steps} of all numbers.
        noise: {key: standard errors of the steps by the noise of this check}.
        unchecked: keys of the numbers whose standard errors are unknown.
        blind: keys of the numbers whose influence on the pictures is hidden by the noise of this check.
        elsewhere: keys of the numbers that only other views show than the tested ones.
        distorted: line about references that look distorted, so that the numbers have no standard errors; "" for none.
        fixed: {key: reason} of unknowns that trade off against the numbers in directions that the test leaves out; {} if there was no
            time for the test.
    """

    undetermined: Mapping[str, str] = field(default_factory=dict)
    unfinished: Mapping[str, str] = field(default_factory=dict)
    errors: Mapping[str, np.ndarray] = field(default_factory=dict)
    steps: Mapping[str, np.ndarray] = field(default_factory=dict)
    noise: Mapping[str, np.ndarray] = field(default_factory=dict)
    unchecked: tuple[str, ...] = ()
    blind: tuple[str, ...] = ()
    elsewhere: tuple[str, ...] = ()
    fixed: Mapping[str, str] = field(default_factory=dict)
    distorted: str = ""

    def missing(self, reported: Collection[str] = ()) -> list[str]:
        """Return lines: why the standard errors of the unchecked numbers, and of those of other views, are unknown.

        Args:
            reported: keys to leave out, since other lines are about them.
        """
        if self.distorted:
            return [self.distorted]
        keys = [key for key in self.unchecked if key not in reported]
        if not keys:
            return [f"{key}: no standard error: the views that are tested do not show it" for key in self.elsewhere]
        if not self.fixed:
            return [f"whether {listed(keys)} converged: {TOO_SHORT}"]
        others = listed([f"{key} ({reason})" for key, reason in self.fixed.items()])
        have = "has no standard error: it is" if len(keys) == 1 else "have no standard errors: they are"
        return [f"{listed(keys)} {have} recovered together with {others}"]

    def noisy(self, known: Collection[str]) -> list[str]:
        """Return at most one line: why the errors of blind numbers are infinite; those of `known` keys are not."""
        keys = [key for key in self.blind if key not in known]
        what = "standard errors are unknown: the noise of the test at the end hides how the pictures depend on them; give more steps"
        return [f"{listed(keys)}: {what}, or less noise, such as by larger lights"] if keys else []

    def standard_errors(
        self, values: Mapping[str, np.ndarray], known: Mapping[str, np.ndarray] | None = None, complete: bool = False
    ) -> dict[str, np.ndarray]:
        """Return the standard errors of the numbers at the end of a run, of the shapes of `values`, float32.

        The squares of the error by the references' noise and of the distance from the least-squares solution are added. An estimate of the
        distance, without its noise σ, is step² − σ². A number is not known better than σ, unless the run states its own error. If that is
        complete, it replaces one of up to three times its size, which is of another solution, and only steps beyond 3 σ are distances.

        Args:
            values: {key: array} at the end of the run.
            known: {key: standard errors} that the run states.
            complete: whether these contain the references' noise; otherwise errors are no smaller than them.
        """
        errors, known = {}, known or {}
        for key, error in self.errors.items():
            square, noise, step = (np.square(x) for x in (error, self.noise[key], self.steps[key]))
            own = np.square(known.get(key, np.full(error.shape, np.inf))).reshape(-1)
            sure = np.isfinite(own)  # a damped run may state none of a number that this check determines
            unstated = np.maximum(square, noise) + np.maximum(step - noise, 0.0)
            if complete:
                limit = 1.0 if self.blind else _OWN**2  # the run does not know more of directions that noise hides
                stated = np.where(square > limit * own, square, own) + np.maximum(step - _CLEAR**2 * noise, 0.0)
            else:
                stated = np.maximum(square + np.maximum(step - noise, 0.0), own)
            errors[key] = np.sqrt(np.where(sure, stated, unstated)).reshape(values[key].shape).astype(np.float32)
        return errors
