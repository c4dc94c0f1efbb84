"""Gradient and Gauss-Newton matrix from the derivative image of every parameter, by differences of renders: for poses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays, checks, vectors
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient, Hessian, HessianNoise, Smoothing
from unrender.estimators.gradient_sum import damping, smoothed_variance
from unrender.rendering.renderer import RenderSession, SampleRequest
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler

_PASSES, _FIRST_CHANGE, _CHANGE = 3, 64.0, 2.0
"""Of the widths: passes of their own before the first estimate, and factors by which a width changes at most, there and later."""
_VALUES = 1 << 22
"""Of images, that are turned into double precision at once."""
_SETTLED = 0.5
"""Longest step, in units of the widths, after which differences become sharper."""
_TRIAL, _LEAST_EIGENVALUE = 3, 0.01
"""Stream of the trial of a start; eigenvalues of its matrix, relative to the largest, that count as 0."""
_MEMORY = 0.3
"""Weight of the latest image in the running mean of the variance."""
_IMAGE = 2
"""Stream of a view's key: of the image. Those below are of the two halves of the derivative images."""


@dataclass(frozen=True)
class GaussNewtonState:
    """State between steps.

    Attributes:
        widths: of the differences, {key: in units of the parameter}; {} before the first estimate.
        shift: in pixels, of the differences.
        point: the parameters of the last estimate, (n,); None before the first.
        variances: running mean of the variance of each view's image, (H, W, 1); () without `noise_limit` and before the first estimate.
    """

    widths: dict[str, float]
    shift: float = 0.0
    point: np.ndarray | None = None
    variances: tuple[np.ndarray, ...] = ()

    def upsampled(self, upsampler: Upsampler) -> GaussNewtonState:
        """See `Upsamplable`: widths are measured anew."""
        del upsampler
        return GaussNewtonState({})


@register
@dataclass(frozen=True)
class GaussNewton:
    """g = Σ J ℓ'(I) and H = Σ J ℓ''(I) Jᵀ over pixels, with a derivative image J for every element of every parameter.

    J is the central difference of renders from the same random numbers, at ± a width. The width is found for each parameter, so that
    both renders differ from the picture by as much as a shift by `shift` pixels does. It is the unit of trust regions, too
    (`Smoothing`). Images and derivative images have samples of their own, and H is the product of two halves of the derivative images,
    made symmetric: no product contains the square of a noise. Their difference tells what noise would add (`HessianNoise`).

    Bias: J is the derivative averaged over ± the width, so g and H are those of nearby parameters. The expected gradient vanishes where
    the expected image is the reference, as the loss's does, for a loss whose derivative is linear in the image. H leaves out the
    curvature of the image, as Gauss-Newton does, and by its noise it may have negative eigenvalues. Of other losses of single pixels, L1
    and Huber, ℓ' is damped where noise exceeds the residual (see `PathGradient`, `tolerance`), and the secant ℓ'(r) / r stands for ℓ''.

    For few parameters, such as poses of sensors: each element takes two renders of every view that it changes, and no derivative of the
    renderer, so whatever can be rendered will do. A sensor's own parameters change its own views alone.

    Args:
        spp: samples per pixel of the image, >= 2.
        derivative_spp: of the renders that differences are made of, >= 2.
        shift: in pixels, > 0. Smaller ones are sharper, with more noise at edges.
        width: of the differences before the first estimate finds better ones, > 0: a share of a parameter's largest value, or in its units
            if all values are 0.
        tolerance: κ > 0 of the damping, for losses whose derivative is not linear.
        coarse: `shift` at the start, in pixels, >= `shift`; None for `shift` itself. It halves after each step that is short beside the
            widths. Images and derivative images are summed over blocks as wide as the shift, so a wide difference has little noise, and
            a start that is several pixels away takes few steps.
        largest: {key: largest width, > 0}; no limit for the others. A pose of one shape needs it: the shape covers a part of the picture,
            so no shift of it differs from the picture by as much as a shift of the whole.
        noise_limit: a pixel of variance σ² has the weight 1 / (1 + σ² / (c m)), with this c and the median m over pixels with noise, so a
            few noisy pixels, such as those of a visible lamp, do not outweigh the others; > 0. None for equal weights.
    """

    spp: int = 256
    derivative_spp: int = 32
    shift: float = 0.3
    width: float = 0.01
    tolerance: float = 2.0
    coarse: float | None = None
    largest: Mapping[str, float] = field(default_factory=dict)
    noise_limit: float | None = None

    def __post_init__(self):
        for key, width in self.largest.items():
            checks.number("GaussNewton", f"largest of {key}", width, above=0.0)
        for name in ("spp", "derivative_spp"):
            checks.integer("GaussNewton", name, getattr(self, name), at_least=2)
        for name in ("shift", "width", "tolerance"):
            checks.number("GaussNewton", name, getattr(self, name), above=0.0)
        if self.noise_limit is not None:
            checks.number("GaussNewton", "noise_limit", self.noise_limit, above=0.0)
        if self.coarse is not None and checks.number("GaussNewton", "coarse", self.coarse, above=0.0) < self.shift:
            raise InputError(f"GaussNewton: coarse must be at least shift, {self.shift:g}, got {self.coarse:g}")

    @property
    def provides(self) -> Capabilities:
        """A gradient, a Hessian and its noise."""
        return Capabilities(Gradient, Hessian, HessianNoise)

    def init(self, problem: Problem, parameters: Tree) -> GaussNewtonState:
        """See `Estimator.init`. Raises `InputError` for a parameter that cannot be perturbed or has a preconditioner, and for a loss of
        several pixels together."""
        if not (problem.loss.linear or problem.loss.pixelwise):
            raise InputError(
                f"GaussNewton requires a loss of single pixels, such as L2, got {type(problem.loss).__name__}"
            )
        for key in (key for key in problem.coordinates.preconditioners if key in parameters):
            raise InputError(f"GaussNewton: parameter {key} has a preconditioner; leave it out, H takes its place")
        problem.renderer.prepare(list(parameters), None, derivatives=False)
        return GaussNewtonState({})

    def estimate(
        self, problem: Problem, parameters: Tree, state: GaussNewtonState, key: Key
    ) -> tuple[Estimate, GaussNewtonState]:
        """See `Estimator.estimate`. `info`: "samples" (paths traced), "images" per view."""
        point = _Point(self, problem, parameters)
        if not state.widths:
            widths = {key: self.width * (float(np.abs(arrays.numpy(x)).max()) or 1.0) for key, x in parameters.items()}
            widths = {key: min(width, self.largest.get(key, math.inf)) for key, width in widths.items()}
            state = GaussNewtonState(widths, self.coarse or self.shift, point.theta)
            for index in range(_PASSES):
                found = point.system(state, key.fold(1 + index), derivatives=False)
                state = self._next(state, found, parameters, _FIRST_CHANGE)
        state = self._sharpened(state, parameters)
        found = point.system(state, key.fold(0))
        estimate = Estimate(
            found.loss,
            vectors.unravel(found.gradient, parameters),
            (Hessian(found.hessian), HessianNoise(found.noise), Smoothing(dict(state.widths))),
            {"samples": point.samples, "images": found.images},
        )
        return estimate, self._next(state, found, parameters, _CHANGE)

    def _sharpened(self, state: GaussNewtonState, parameters: Tree) -> GaussNewtonState:
        """Return the state with half the shift, where the last step was short beside the widths."""
        point = vectors.ravel(parameters)
        if state.point is None:
            return GaussNewtonState(state.widths, state.shift or self.coarse or self.shift, point)
        moved = np.abs(point - state.point) / vectors.repeat_per_element(state.widths, parameters)
        settled = 0.0 < moved.max(initial=0.0) < _SETTLED
        shift = max(0.5 * state.shift, self.shift) if settled else state.shift
        return replace(state, shift=shift, point=point)

    def _next(self, state: GaussNewtonState, found: _System, parameters: Tree, change: float) -> GaussNewtonState:
        """With the widths at which renders differ from the picture as a shift by so many pixels does, root mean square over the elements of
        a parameter; no more than `change` times what they were, or less by it."""
        squares, slopes = vectors.parts(found.squares, parameters), vectors.parts(found.slopes, parameters)
        widths = {}
        for key, width in state.widths.items():
            square, slope = float(squares[key].mean()), float(slopes[key].mean())
            wanted = state.shift * math.sqrt(slope / square) if square > 0.0 and slope > 0.0 else width
            widths[key] = float(np.clip(wanted, width / change, min(width * change, self.largest.get(key, math.inf))))
        return replace(state, widths=widths, variances=tuple(found.variances) or state.variances)


def explained(problem: Problem, estimator: GaussNewton, seed: int = 0) -> float:
    """Return the share of the initial loss that the quadratic model at the start promises to remove.

    It is near 0 on a plateau, where no derivative image resembles the residual. Noise does not add to it: gradients and images come from
    two independent estimates. The loss must be linear in its derivative, such as L2.
    """
    first = problem.initial()
    state, found, losses, images = estimator.init(problem, first), [], [], []
    for step in range(2):
        estimate, state = estimator.estimate(problem, first, state, Key(seed, step, stream=_TRIAL))
        found.append(estimate)
        losses.append(estimate.loss)
        images.append(estimate.info["images"])
    mean = sum(
        arrays.number(problem.loss_value(view, 0.5 * (image + images[1][view]))) for view, image in images[0].items()
    )
    loss = 2.0 * mean - 0.5 * sum(losses)
    hessian = 0.5 * sum(arrays.numpy(estimate.require("explained", Hessian).matrix) for estimate in found)
    one, other = (vectors.ravel(estimate.gradient) for estimate in found)
    units = np.sqrt(np.abs(np.diag(hessian)))
    if loss <= 0.0 or not np.isfinite(hessian).all() or not units.all():
        return 0.0
    inverse = np.linalg.pinv(hessian / np.outer(units, units), rcond=_LEAST_EIGENVALUE, hermitian=True)
    return float(0.5 * (one / units) @ inverse @ (other / units) / loss)


@dataclass
class _System:
    """What the views say together, of n elements.

    Attributes:
        loss: at the parameters.
        gradient, hessian, noise: (n,), (n, n), (n, n).
        squares: of the derivative images, summed over their pixels, (n,).
        slopes: squared differences of neighbouring pixels, summed over the views that the element changes, (n,).
        images: by view.
        variances: running mean of the variance of each view's image.
    """

    loss: float
    gradient: np.ndarray
    hessian: np.ndarray
    noise: np.ndarray
    squares: np.ndarray
    slopes: np.ndarray
    images: dict[int, Array]
    variances: list[np.ndarray] = field(default_factory=list)

    @classmethod
    def zero(cls, n: int) -> _System:
        return cls(0.0, np.zeros(n), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n), np.zeros(n), {})


class _Point:
    """Images and derivative images of a problem at its parameters.

    Attributes:
        samples: paths traced so far.
    """

    def __init__(self, options: GaussNewton, problem: Problem, parameters: Tree):
        self.options, self.problem, self.parameters = options, problem, parameters
        self.session: RenderSession = problem.renderer.prepare(list(parameters), None, derivatives=False)
        self.theta = vectors.ravel(parameters)
        self.samples = 0
        known = problem.renderer.parameters()
        sensors = {key: -1 if known[key].sensor is None else known[key].sensor for key in parameters}
        self._sensors = vectors.repeat_per_element(sensors, parameters)  # pyright: ignore[reportArgumentType]

    def system(self, state: GaussNewtonState, key: Key, derivatives: bool = True) -> _System:
        """Gradient and Hessian at differences of the state's widths; without `derivatives`, what the next widths are found by alone."""
        found = _System.zero(self.theta.size)
        steps = vectors.repeat_per_element(state.widths, self.parameters)
        for view, of in enumerate(self.problem.views):
            elements = np.flatnonzero((self._sensors == -1) | (self._sensors == of.sensor))
            own = key.fold(view)
            image, variance = self._image(view, own) if derivatives else (None, None)
            if derivatives:
                found.images[view] = image
                if self.options.noise_limit is not None:
                    found.variances.append(_running(state.variances, view, arrays.numpy(variance)))
                found.loss += arrays.number(self.problem.loss_value(view, image))
            if not elements.size:
                continue
            points, distances = self._points(elements, steps)
            halves = [self._states(points, view, own.fold(half), self.options.derivative_spp) for half in (0, 1)]
            slope = _slope(halves)
            weights = None if image is None else self._weights(view, image, variance)
            if weights is not None and found.variances:
                # After the first step they come from earlier images too, so they hardly correlate with the noise of this one.
                factor = noise_weights(found.variances[view], self.options.noise_limit or math.inf)
                weights = weights[0] * factor, weights[1] * factor
            gradient, hessian, noise, squares = _products(halves, distances, weights, int(state.shift))
            found.gradient[elements] += gradient
            found.hessian[np.ix_(elements, elements)] += hessian
            found.noise[np.ix_(elements, elements)] += noise
            found.squares[elements] += squares
            found.slopes[elements] += slope
        return found

    def _points(self, elements: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The parameters with one element more by its step, for each, and then less, (2 m, n), within bounds; how far apart the two are,
        (m,)."""
        unknowns = self.problem.unknowns
        offsets = np.zeros((2, elements.size, self.theta.size))
        offsets[0, np.arange(elements.size), elements] = steps[elements]
        offsets[1, np.arange(elements.size), elements] = -steps[elements]
        states = vectors.parts(self.theta + offsets, self.parameters)
        inside = [unknowns[key].project(x).reshape(*x.shape[:2], -1) for key, x in states.items()]
        points = np.concatenate(inside, axis=-1).astype(np.float32).astype(np.float64)
        distances = points[0, np.arange(elements.size), elements] - points[1, np.arange(elements.size), elements]
        return points.reshape(-1, self.theta.size), distances

    def _states(self, points: np.ndarray, view: int, key: Key, spp: int) -> np.ndarray:
        """Half the samples of images (B, H, W, 3) at points (B, n), all from the same random numbers."""
        request = SampleRequest(self.problem.views[view].sensor, spp // 2, key.uint32())
        stacked = {key: x.astype(np.float32) for key, x in vectors.parts(points, self.parameters).items()}
        for name, x in stacked.items():
            if (x == x[:1]).all():  # shared by all, see `RenderSession.image_batch`
                stacked[name] = np.broadcast_to(x[0], x.shape)
        images = arrays.numpy(self.session.image_batch(stacked, request))
        self.samples += images.shape[0] * images.shape[1] * images.shape[2] * request.spp
        return images

    def _image(self, view: int, key: Key) -> tuple[Array, Array]:
        """The image, and its variance from two halves."""
        halves = [self._states(self.theta[None], view, key.fold(_IMAGE + half), self.options.spp)[0] for half in (0, 1)]
        mean = 0.5 * (halves[0] + halves[1])
        return self.problem.renderer.array(mean), self.problem.renderer.array(0.25 * np.square(halves[0] - halves[1]))

    def _weights(self, view: int, image: Array, variance: Array) -> tuple[np.ndarray, np.ndarray]:
        """ℓ' and ℓ'' at the image, (H, W, 3) each."""
        problem = self.problem
        derivative = problem.loss_derivative(view, image)
        if problem.loss.linear:
            return arrays.numpy(derivative), arrays.numpy(problem.loss_derivative(view, image + 1.0) - derivative)
        residual = image - problem.reference(view)
        derivative = derivative * damping(residual, smoothed_variance(variance), self.options.tolerance)
        secant = derivative * residual / (residual * residual + 1e-12)
        return arrays.numpy(derivative), arrays.numpy(secant)


def noise_weights(variance: np.ndarray, limit: float) -> np.ndarray:
    """Return the weight 1 / (1 + σ² / (c m)) of each pixel, with c = `limit` and the median m of the variances σ² above 0.

    It is 1 where no pixel has noise.
    """
    noisy = variance[variance > 0.0]
    return 1.0 / (1.0 + variance / (limit * float(np.median(noisy)))) if noisy.size else np.ones_like(variance)


def _running(before: tuple[np.ndarray, ...], view: int, variance: np.ndarray) -> np.ndarray:
    """Return the running mean of a view's variance (H, W, 1), from those of all views and the new one (H, W, 3)."""
    new = variance.astype(np.float64).mean(axis=-1, keepdims=True)
    return before[view] + _MEMORY * (new - before[view]) if before else new


def _slope(halves: list[np.ndarray]) -> float:
    """The squared differences of neighbouring pixels of the mean image, summed, mean of the two directions; without noise, from two
    independent halves (B, H, W, 3)."""
    one, other = (half.mean(axis=0, dtype=np.float64) for half in halves)
    return 0.5 * sum(float((np.diff(one, axis=axis) * np.diff(other, axis=axis)).sum()) for axis in (0, 1))


def _products(
    halves: list[np.ndarray], distances: np.ndarray, weights: tuple[np.ndarray, np.ndarray] | None, block: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Σ J ℓ', Σ J ℓ'' Jᵀ, Σ N ℓ'' Nᵀ with the noise N of the mean of the halves, and the diagonal of Σ J Jᵀ over pixels, from two
    independent halves of J.

    Args:
        halves: images (2 m, H, W, 3), those at more and those at less.
        distances: of the two parameters of each difference, (m,); an element with 0 has no derivative.
        weights: ℓ' and ℓ''; None where only the last is wanted.
        block: side of the blocks of pixels over which all but the last are summed.
    """
    m = distances.size
    gradient, hessian, noise, squares = np.zeros(m), np.zeros((m, m)), np.zeros((m, m)), np.zeros(m)
    over = np.divide(1.0, distances, out=np.zeros(m), where=distances != 0.0)[:, None]
    for rows in _rows(halves[0], max(block, 1)):
        parts = [_difference(half[:, rows]) for half in halves]
        one, other = (part.reshape(m, -1) * over for part in parts)
        squares += (one * other).sum(axis=1)
        if weights is None:
            continue
        first, second = (x[rows].astype(np.float64) for x in weights)
        if block > 1:
            one, other = (_pooled(part, block).reshape(m, -1) * over for part in parts)
            first, second = _pooled(first, block), _pooled(second, block) / _pooled(np.ones_like(second), block)
        first, second = first.reshape(-1), second.reshape(-1)
        gradient += 0.5 * ((one + other) @ first)
        hessian += (one * second) @ other.T
        apart = 0.5 * (one - other)
        noise += (apart * second) @ apart.T
    return gradient, 0.5 * (hessian + hessian.T), noise, squares


def _pooled(images: np.ndarray, block: int) -> np.ndarray:
    """Sums over blocks of pixels, over the square root of their number, of images (..., H, W, 3)."""
    for axis in (-3, -2):
        starts = np.arange(0, images.shape[axis], block)
        sizes = np.diff(np.append(starts, images.shape[axis]))
        shape = [1] * images.ndim
        shape[axis] = -1
        images = np.add.reduceat(images, starts, axis=axis) / np.sqrt(sizes).reshape(shape)
    return images


def _difference(images: np.ndarray) -> np.ndarray:
    """Of the first half of the images and the second, (m, H, W, 3), in double precision."""
    count = len(images) // 2
    return images[:count].astype(np.float64) - images[count:]


def _rows(images: np.ndarray, block: int) -> Iterator[slice]:
    """Return whole blocks of rows, of some million values of all images or fewer."""
    height = images.shape[1]
    step = max(_VALUES // max(images[:, :1].size * block, 1), 1) * block
    for start in range(0, height, step):
        yield slice(start, start + step)
