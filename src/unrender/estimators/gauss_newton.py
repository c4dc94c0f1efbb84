"""Gradient and Gauss-Newton matrix from finite-difference derivative images of every parameter, for few parameters such as poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.text import did_you_mean
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import (
    Capabilities,
    DerivativeImages,
    Gradient,
    GradientNoise,
    Hessian,
    HessianNoise,
    ScoreCovariance,
    Smoothing,
)
from unrender.estimators.derivative_images import (
    MOST_AVERAGED,
    HalvedImage,
    HalvesMean,
    LossWeights,
    Products,
    differences,
    mean_residuals,
    noise_weights,
    products,
    references_have_noise,
    running_mean,
    squared_slope,
)
from unrender.estimators.gradient_sum import damping, smoothed_variance
from unrender.rendering.renderer import RenderSession, SampleRequest
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler
from unrender.statistics.scores import positive_inverse

_PASSES, _FIRST_CHANGE, _CHANGE = 3, 64.0, 2.0
"""Number of passes that adapt the widths before the first estimate, and maximum factors of change of a width, then and later."""
_OF_RANGE, _BLIND = 0.125, 0.3
"""Largest width relative to the range between a parameter's bounds. Width up to which it grows while differences change no picture,
relative to the parameter, or in its units if it is 0."""
_SETTLED = 0.5
"""Maximum step, in units of the widths, after which the shift is halved."""
_IMAGE = 2
"""Stream of a view's key for the image. Lower streams are for the two halves of the derivative images."""


@dataclass(frozen=True)
class GaussNewtonState:
    """State between steps.

    Attributes:
        widths: widths of the differences, {key: in units of the parameter}; {} before the first estimate.
        shift: target image shift of the differences in pixels.
        point: parameters of the last estimate, (n,); None before the first.
        variances: running mean of the variance of each view's image, (H, W, 1), or (H, W, 3) by channel; () without `noise_limit` and
            before the first estimate.
        derivatives: mean derivative images of each view; () without `remember` and before the first estimate.
        residuals: mean derivatives of the loss of each view, moved along to `point`; () without scores and before the first estimate.
        hessian: last Hessian, (n, n); None without scores and before the first estimate.
    """

    widths: dict[str, float]
    shift: float = 0.0
    point: np.ndarray | None = None
    variances: tuple[np.ndarray, ...] = ()
    derivatives: tuple[HalvesMean, ...] = ()
    residuals: tuple[HalvesMean, ...] = ()
    hessian: np.ndarray | None = None

    def upsampled(self, upsampler: Upsampler) -> GaussNewtonState:
        """Return an empty state: widths are estimated again."""
        del upsampler
        return GaussNewtonState({})


@register
@dataclass(frozen=True)
class GaussNewton:
    """g = Σ J ℓ'(I) and H = Σ J ℓ''(I) Jᵀ over pixels, with a derivative image J for every element of every parameter.

    J is the central difference of renders with the same random numbers, at ± a width. The width of each parameter is chosen so that
    both renders differ from the image as much as a shift by `shift` pixels would. It is also the unit of trust regions (`Smoothing`).
    Images and derivative images have independent samples. H is the symmetrised product of two independent halves of the derivative
    images, so no product contains squared noise. Their difference estimates what noise would add (`HessianNoise`). The mean
    residuals of two halves of all images give the gradient's covariance from the references' noise (`ScoreCovariance`).

    Bias: J is the derivative averaged over ± the width, so g and H are those of nearby parameters. The expected gradient vanishes where
    the expected image equals the reference, for a loss whose derivative is linear in the image. H neglects the curvature of the image,
    as in Gauss-Newton, and noise may give it negative eigenvalues. For other per-pixel losses, L1 and Huber, ℓ' is damped where noise
    exceeds the residual (see `PathGradient`, `tolerance`), and the secant ℓ'(r) / r replaces ℓ''.

    Use it for few parameters, such as poses of sensors: each element takes two renders of every view that it changes. It needs no
    derivative of the renderer, so every parameter that can be rendered is supported. A sensor's own parameters only change its own
    views.

    Args:
        spp: samples per pixel of the image, >= 2.
        derivative_spp: samples per pixel of the renders of differences, >= 2.
        shift: target image shift in pixels, > 0. Smaller values are less biased, with more noise at edges.
        width: initial width of the differences, > 0: a fraction of the largest absolute value of a parameter, or in units of the parameter
            if all values are 0.
        tolerance: κ > 0 of the damping, for losses whose derivative is not linear.
        coarse: `shift` at the start, in pixels, >= `shift`; None for `shift` itself. It is halved after each step that is short
            relative to the widths. Images and derivative images are summed over blocks as wide as the shift, so a large shift has
            little noise, and a start several pixels away takes few steps.
        largest: {key: maximum width, > 0}; no limit for the others. The pose of one shape needs it: the shape covers a part of the
            image, so it may never differ from the image as much as a shift of the full image would.
        noise_limit: a pixel of variance σ² in earlier images has the weight 1 / (1 + σ² / (c m)), with this c and the median m over pixels
            with noise, so a few noisy pixels, such as those of a visible lamp, do not outweigh the others; > 0. None for equal weights.
        by_channel: whether each channel of a pixel has its own variance and weight.
        remember: whether derivative images are averaged over steps while steps are short relative to the widths. Their noise is then
            small relative to the derivatives also for elements that hardly change the image. Not for large pictures of many elements.
        scores: whether residuals are averaged over steps for `ScoreCovariance`, which standard errors need. Problems of more than
            `MOST_AVERAGED` pixels in all views have no scores, since the mean takes 24 bytes per pixel. Runs whose optimizer states no
            errors do without.
        derivative_images: whether those of all views are returned (`DerivativeImages`), which takes 12 bytes per pixel and element.
    """

    spp: int = 256
    derivative_spp: int = 32
    shift: float = 0.3
    width: float = 0.01
    tolerance: float = 2.0
    coarse: float | None = None
    largest: Mapping[str, float] = field(default_factory=dict)
    noise_limit: float | None = None
    by_channel: bool = False
    remember: bool = False
    scores: bool = True
    derivative_images: bool = False

    def __post_init__(self):
        checks.flags(self)
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
        """A gradient and its noise, a Hessian and its noise; with `scores`, the covariance by the references' noise; with
        `derivative_images`, these."""
        scores = (ScoreCovariance,) if self.scores else ()
        images = (DerivativeImages,) if self.derivative_images else ()
        return Capabilities(Gradient, GradientNoise, Hessian, HessianNoise, *scores, *images)

    def init(self, problem: Problem, parameters: Tree) -> GaussNewtonState:
        """Return the state before the first step. Raise `InputError` for a parameter that cannot be perturbed or has a preconditioner,
        and for a loss that is not per pixel."""
        if not (problem.loss.linear or problem.loss.pixelwise):
            raise InputError(f"GaussNewton requires a per-pixel loss, such as L2, got {type(problem.loss).__name__}")
        if unknown := next((key for key in self.largest if key not in parameters), None):
            raise InputError(
                f"GaussNewton: largest names {unknown}, which is not a parameter{did_you_mean(unknown, parameters)}"
            )
        for key in (key for key in problem.coordinates.preconditioners if key in parameters):
            raise InputError(f"GaussNewton: parameter {key} has a preconditioner, which H replaces; leave it out")
        problem.renderer.prepare(list(parameters), None, derivatives=False)
        return GaussNewtonState({})

    def estimate(
        self, problem: Problem, parameters: Tree, state: GaussNewtonState, key: Key
    ) -> tuple[Estimate, GaussNewtonState]:
        """Return an estimate and the next state. `info`: "samples" (paths traced), "images" per view."""
        point = _Point(self, problem, parameters)
        if not state.widths:
            widths = {key: self.width * (float(np.abs(arrays.numpy(x)).max()) or 1.0) for key, x in parameters.items()}
            widths = {key: min(width, point.largest[key]) for key, width in widths.items()}
            state = GaussNewtonState(widths, self.coarse or self.shift, point.theta)
            for index in range(_PASSES):
                system = point.system(state, key.fold(1 + index))
                state = self._next(state, system, point, _FIRST_CHANGE)
        step = np.zeros_like(point.theta) if state.point is None else point.theta - state.point
        moved = float(np.max(np.abs(step) / trees.repeat_per_element(state.widths, parameters), initial=0.0))
        state = self._sharpened(state, point.theta, moved)
        system = point.system(state, key.fold(0), step, moved)
        sums = system.products
        noisy = references_have_noise(system.residuals)
        scores = (ScoreCovariance(sums.scores if noisy else np.zeros_like(sums.scores)),) if point.scores else ()
        images = (DerivativeImages(system.weighted),) if self.derivative_images else ()
        estimate = Estimate(
            system.loss,
            trees.unravel(sums.gradient, parameters),
            (
                Hessian(sums.hessian),
                HessianNoise(sums.noise),
                GradientNoise(sums.gradient_noise),
                Smoothing(dict(state.widths)),
                *scores,
                *images,
            ),
            {"samples": point.samples, "images": system.images},
        )
        return estimate, self._next(state, system, point, _CHANGE)

    def _sharpened(self, state: GaussNewtonState, point: np.ndarray, moved: float) -> GaussNewtonState:
        """Return the state at a point, with half the shift if the last step was short relative to the widths."""
        shift = state.shift or self.coarse or self.shift
        settled = 0.0 < moved < _SETTLED
        return replace(state, shift=max(0.5 * shift, self.shift) if settled else shift, point=point)

    def _next(self, state: GaussNewtonState, system: _System, point: _Point, change: float) -> GaussNewtonState:
        """Return the state with updated widths, at which renders differ from the image as much as the target shift, in the root mean
        square over the elements of a parameter. Widths change by at most the factor `change`."""
        squares, slopes = (trees.parts(x, point.parameters) for x in (system.products.squares, system.slopes))
        widths = {}
        for key, width in state.widths.items():
            square, slope = float(squares[key].mean()), float(slopes[key].mean())
            target = state.shift * math.sqrt(slope / square) if square > 0.0 and slope > 0.0 else width
            if square <= 0.0 < slope:  # few samples show no small change
                target = max(width, _BLIND * (float(np.abs(arrays.numpy(point.parameters[key])).max()) or 1.0))
            widths[key] = float(np.clip(target, width / change, min(width * change, point.largest[key])))
        return replace(
            state,
            widths=widths,
            variances=tuple(system.variances) or state.variances,
            derivatives=tuple(system.derivatives) or state.derivatives,
            residuals=tuple(system.residuals),
            hessian=system.products.hessian if system.residuals else None,
        )


@dataclass
class _System:
    """Sums over all views, for n elements.

    Attributes:
        products: products of derivative images.
        slopes: squared differences of neighbouring pixels, summed over the views that the element changes, (n,).
        weighted: derivative images by view, see `DerivativeImages`; {} unless `GaussNewton.derivative_images`.
        variances: running mean of the variance of each view's image.
        derivatives: mean derivative images of each view.
        residuals: mean derivatives of the loss of each view.
    """

    products: Products
    slopes: np.ndarray
    loss: float = 0.0
    images: dict[int, Array] = field(default_factory=dict)
    weighted: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=dict)
    variances: list[np.ndarray] = field(default_factory=list)
    derivatives: list[HalvesMean] = field(default_factory=list)
    residuals: list[HalvesMean] = field(default_factory=list)


class _Point:
    """Images and derivative images of a problem at its parameters.

    Attributes:
        samples: number of paths traced so far.
        largest: largest width of each parameter, infinite if there is none.
        scores: whether residuals are averaged over steps.
    """

    def __init__(self, options: GaussNewton, problem: Problem, parameters: Tree):
        self.options, self.problem, self.parameters = options, problem, parameters
        self.session: RenderSession = problem.renderer.prepare(list(parameters), None, derivatives=False)
        self.theta = trees.ravel(parameters)
        self.samples = 0
        self.scores = options.scores and problem.pixels <= MOST_AVERAGED
        ranges = {key: (unknown.bounds[0], unknown.bounds[1]) for key, unknown in problem.unknowns.items()}
        self.largest = {
            key: min(
                options.largest.get(key, math.inf),
                math.inf if low is None or high is None else _OF_RANGE * (high - low),
            )
            for key, (low, high) in ranges.items()
        }
        known = problem.renderer.parameters()
        sensors = {key: -1 if known[key].sensor is None else known[key].sensor for key in parameters}
        self._sensors = trees.repeat_per_element(sensors, parameters)  # pyright: ignore[reportArgumentType]

    def system(self, state: GaussNewtonState, key: Key, step: np.ndarray | None = None, moved: float = 0.0) -> _System:
        """Return gradient and Hessian for the state's widths, after a step (n,) of length `moved` in units of the widths. Without a step,
        only compute the quantities that the next widths need."""
        total = _System(Products.zero(self.theta.size), np.zeros(self.theta.size))
        steps = trees.repeat_per_element(state.widths, self.parameters)
        inverse = None if state.hessian is None else positive_inverse(state.hessian)
        for view, sensor_view in enumerate(self.problem.views):
            elements = np.flatnonzero((self._sensors == -1) | (self._sensors == sensor_view.sensor))
            seed = key.fold(view)
            images = self._images(view, seed) if step is not None else None
            if images:
                total.images[view] = images.mean
                total.loss += arrays.number(self.problem.loss_value(view, images.mean))
            weights = self._noise_weighted(view, images, state, total) if images else None
            if not elements.size:
                continue
            points, distances = self._points(elements, steps)
            halves = [self._states(points, view, seed.fold(half), self.options.derivative_spp) for half in (0, 1)]
            mean = HalvesMean(differences(halves[0], distances), differences(halves[1], distances))
            if weights is not None and self.options.derivative_images:
                total.weighted[view] = (elements, 0.5 * (mean.one + mean.other), weights.second)
            if images and self.options.remember:
                if state.derivatives:
                    mean = state.derivatives[len(total.derivatives)].and_one(mean, moved)
                total.derivatives.append(mean)
            residuals = None
            if self.scores and weights is not None and step is not None:
                before = state.residuals[len(total.residuals)] if state.residuals else None
                residuals = mean_residuals(before, weights, mean, step[elements], moved)
                total.residuals.append(residuals)
            own = None if inverse is None else inverse[np.ix_(elements, elements)]
            parts = [mean.one, mean.other], weights, residuals, int(state.shift), self.options.remember, own
            total.products.add(products(*parts), elements)
            total.slopes[elements] += squared_slope(halves)
        return total

    def _noise_weighted(self, view: int, images: HalvedImage, state: GaussNewtonState, total: _System) -> LossWeights:
        """Return the derivatives of the loss with the weights of the noise, and add the image's variance to `total`.

        The weights are of earlier images only. A bright outlier has a large residual and a large variance, so weights by this image's
        variance would shift the solution to darker images.
        """
        weights, limit = self._weights(view, images), self.options.noise_limit
        if limit is None:
            return weights
        total.variances.append(
            running_mean(state.variances, view, arrays.numpy(images.variance), self.options.by_channel)
        )
        return weights.times(noise_weights(state.variances[view], limit)) if state.variances else weights

    def _points(self, elements: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the parameters with one element increased, then decreased, by its step, (2 m, n), within bounds, and the distances of
        both, (m,)."""
        unknowns = self.problem.unknowns
        offsets = np.zeros((2, elements.size, self.theta.size))
        offsets[0, np.arange(elements.size), elements] = steps[elements]
        offsets[1, np.arange(elements.size), elements] = -steps[elements]
        states = trees.parts(self.theta + offsets, self.parameters)
        inside = [unknowns[key].project(x).reshape(*x.shape[:2], -1) for key, x in states.items()]
        points = np.concatenate(inside, axis=-1).astype(np.float32).astype(np.float64)
        distances = points[0, np.arange(elements.size), elements] - points[1, np.arange(elements.size), elements]
        return points.reshape(-1, self.theta.size), distances

    def _states(self, points: np.ndarray, view: int, key: Key, spp: int) -> np.ndarray:
        """Render images (B, H, W, 3) at points (B, n) with half of the samples, all with the same random numbers."""
        request = SampleRequest(self.problem.views[view].sensor, spp // 2, key.uint32())
        stacked = {key: x.astype(np.float32) for key, x in trees.parts(points, self.parameters).items()}
        for name, x in stacked.items():
            if (x == x[:1]).all():  # shared by all, see `RenderSession.image_batch`
                stacked[name] = np.broadcast_to(x[0], x.shape)
        images = arrays.numpy(self.session.image_batch(stacked, request))
        self.samples += images.shape[0] * images.shape[1] * images.shape[2] * request.spp
        return images

    def _images(self, view: int, key: Key) -> HalvedImage:
        """Return the image and its two halves."""
        halves = [self._states(self.theta[None], view, key.fold(_IMAGE + half), self.options.spp)[0] for half in (0, 1)]
        array = self.problem.renderer.array
        mean, variance = 0.5 * (halves[0] + halves[1]), 0.25 * np.square(halves[0] - halves[1])
        return HalvedImage(array(mean), array(variance), array(halves[0]), array(halves[1]))

    def _weights(self, view: int, images: HalvedImage) -> LossWeights:
        """Return ℓ' and ℓ'' at the image, and ℓ' at its halves, (H, W, 3) each."""
        problem, image = self.problem, images.mean
        derivative = problem.loss_derivative(view, image)
        if problem.loss.linear:
            second = problem.loss_derivative(view, image + 1.0) - derivative
            halves = (problem.loss_derivative(view, half) for half in (images.one, images.other))
            return LossWeights(*map(arrays.numpy, (derivative, second, *halves)))
        residual = image - problem.reference(view)
        damped = derivative * damping(residual, smoothed_variance(images.variance), self.options.tolerance)
        secant = damped * residual / (residual * residual + 1e-12)
        return LossWeights(*map(arrays.numpy, (damped, secant, damped, damped)))
