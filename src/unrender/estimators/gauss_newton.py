"""Gradient and Gauss-Newton matrix from finite-difference derivative images of every parameter, for few parameters such as poses."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.checks import Positive, PositiveByKey, Several
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
    HalvesMean,
    cost,
    needs_derivatives,
    next_weight,
    noise_weights,
    references_have_noise,
)
from unrender.estimators.gauss_newton_system import Point, System
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler
from unrender.statistics.scores import positive_inverse, scaled_eigh

_PASSES, _FIRST_CHANGE, _CHANGE = 3, 64.0, 2.0
"""Number of passes that adapt the widths before the first estimate, and maximum factors of change of a width, then and later."""
_BLIND = 0.3
"""Width up to which it grows while differences change no picture, relative to the parameter, or in its units if it is 0."""
_SETTLED = 0.5  # maximum step, in units of the widths, after which the shift is halved
_DRIFT = 0.25  # distance, in units of the widths, from which on mean derivative images are of another point
_MOST_WRONG, _SECANT_ERRORS, _SECANT_KNOWN, _SHARPEST = 0.5, 3.0, 0.2, 1 / 16
"""Relative error of the predicted change of images from which on differences are too wide, since a step with it leaves half of the
distance; standard errors beyond it, which noise exceeds in at most 0.3 % of tests; standard error at which it is known; least
`sharpness`, at which noise has 16² times the variance."""
_NARROWER = 0.7  # ratio of a width to the one with which mean derivative images began, below which they begin anew


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
        hessian: last Hessian, (n, n); None before the first estimate.
        images: effective number of images since the last long step.
        origin: parameters of the last derivative images, (n,); None before the first estimate.
        noise: noise of the mean derivative images relative to the derivatives, averaged over directions.
        differenced: widths with which the mean derivative images began; {} before the first estimate.
        pictures: mean image of each view; () for losses whose derivative is linear, and before the first estimate.
        anchor, anchor_point: an earlier image of each view, and its parameters, (n,), since which derivative images are tested.
        sharpness: factor of the target shift, at most 1, smaller where derivative images did not predict the change of images.
    """

    widths: dict[str, float]
    shift: float = 0.0
    point: np.ndarray | None = None
    variances: tuple[np.ndarray, ...] = ()
    derivatives: tuple[HalvesMean, ...] = ()
    residuals: tuple[HalvesMean, ...] = ()
    hessian: np.ndarray | None = None
    images: float = 0.0
    origin: np.ndarray | None = None
    noise: float = 0.0
    differenced: dict[str, float] = field(default_factory=dict)
    pictures: tuple[HalvesMean, ...] = ()
    anchor: tuple[HalvesMean, ...] = ()
    anchor_point: np.ndarray | None = None
    sharpness: float = 1.0

    @property
    def narrowed(self) -> bool:
        """Whether the widths are much smaller than those of the mean derivative images, which then begin anew."""
        return any(self.widths[key] < _NARROWER * width for key, width in self.differenced.items())

    def upsampled(self, upsampler: Upsampler) -> GaussNewtonState:
        """Return an empty state: widths are estimated again."""
        return GaussNewtonState({})


@register
@dataclass(frozen=True)
class GaussNewton:
    """g = Σ J ℓ'(I) and H = Σ J ℓ''(I) Jᵀ over pixels, with a derivative image J for every element of every parameter.

    J is the central difference of renders with the same random numbers, at ± a width. The width of each parameter is chosen so that
    both renders differ from the image as much as a shift by `shift` pixels would. It is also the unit of trust regions (`Smoothing`).
    Poses, positions and lenses whose sums hardly change the images, by the last H, have differences along these sums.
    Images and derivative images have independent samples. H is the symmetrised product of two independent halves of the derivative
    images, so no product contains squared noise. Their difference estimates what noise would add (`HessianNoise`). The mean
    residuals of two halves of all images give the gradient's covariance from the references' noise (`ScoreCovariance`).

    Bias: J is the derivative averaged over ± the width, so g and H are those of nearby parameters. The expected gradient vanishes where
    the expected image equals the reference, for a loss whose derivative is linear in the image. H neglects the curvature of the image,
    as in Gauss-Newton, and noise may give it negative eigenvalues. For other per-pixel losses, L1 and Huber, the secant w = ℓ'(s) / s
    replaces ℓ'', and w r replaces ℓ', with s² = r² + κ² σ² of earlier images. So ℓ' is linear in this image, whose noise adds no bias.

    Use it for few parameters, such as poses of sensors: each element takes two renders of every view that it changes. It needs no
    derivative of the renderer, so every parameter that can be rendered is supported. A sensor's own parameters only change its own views.

    Args:
        spp: samples per pixel of the image, >= 2.
        derivative_spp: samples per pixel of the renders of differences, >= 2.
        shift: target image shift in pixels, > 0. Smaller values are less biased, with more noise at edges.
        width: initial width of the differences, > 0: a fraction of the largest absolute value of a parameter, or in units of the parameter
            if all values are 0.
        tolerance: κ > 0 of the secant, for losses whose derivative is not linear.
        coarse: `shift` at the start, in pixels, >= `shift`; None for `shift` itself. It is halved after each step that is short
            relative to the widths. Images and derivative images are summed over blocks as wide as the shift, so a large shift has
            little noise, and a start several pixels away takes few steps.
        largest: {key: maximum width, > 0}; no limit for the others. The pose of one shape needs it: the shape covers a part of the
            image, so it may never differ from the image as much as a shift of the full image would.
        noise_limit: a pixel of variance σ² in earlier images has the weight 1 / (1 + σ² / (c m)), with this c and the median m over pixels
            with noise, so a few noisy pixels, such as those of a visible lamp, do not outweigh the others; > 0. None for equal weights.
        by_channel: whether each channel of a pixel has its own variance and weight.
        remember: whether derivative images are averaged over steps while steps are short relative to the widths. Their noise is then
            small relative to the derivatives also for elements that hardly change the image. Steps have no new derivative images where
            images reduce the error more in the same time. Not for large pictures of many elements.
        derivative_noise: noise of mean derivative images, relative to the derivatives, above which every step has new ones if they are
            averaged, > 0. It also multiplies the references' noise, which no image reduces.
        scores: whether residuals are averaged over steps for `ScoreCovariance`, which standard errors need. Problems of more than
            `MOST_AVERAGED` pixels in all views have no scores, since the means take 48 bytes per pixel. Runs whose optimizer states no
            errors do without.
        derivative_images: whether those of all views are returned (`DerivativeImages`), which takes 12 bytes per pixel and element.
    """

    spp: Several = 256
    derivative_spp: Several = 32
    shift: Positive = 0.3
    width: Positive = 0.01
    tolerance: Positive = 2.0
    coarse: Positive | None = None
    largest: PositiveByKey = field(default_factory=dict)
    noise_limit: Positive | None = None
    by_channel: bool = False
    remember: bool = False
    derivative_noise: Positive = 0.1
    scores: bool = True
    derivative_images: bool = False

    def __post_init__(self):
        checks.fields(self)
        if self.coarse is not None and self.coarse < self.shift:
            raise InputError(f"GaussNewton: coarse must be at least shift, {self.shift:g}, got {self.coarse:g}")

    @property
    def provides(self) -> Capabilities:
        """A gradient and its noise, a Hessian and its noise; with `scores`, the covariance by the references' noise; with
        `derivative_images`, these."""
        scores = (ScoreCovariance,) if self.scores else ()
        images = (DerivativeImages,) if self.derivative_images else ()
        return Capabilities(Gradient, GradientNoise, Hessian, HessianNoise, *scores, *images)

    def pixel_weights(self, state: GaussNewtonState) -> tuple[np.ndarray, ...]:
        limit = self.noise_limit
        return tuple(noise_weights(variance, limit) for variance in state.variances) if limit else ()

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
        """Return an estimate and the next state. `info`: "samples" (paths traced), "images" per view.

        An estimate that is not finite leaves the state unchanged.
        """
        before = state
        point = Point(self, problem, parameters)
        if not state.widths:
            widths = {key: self.width * (float(np.abs(arrays.numpy(x)).max()) or 1.0) for key, x in parameters.items()}
            widths = {key: min(width, point.largest[key]) for key, width in widths.items()}
            state = GaussNewtonState(widths, self.coarse or self.shift, point.theta)
            for index in range(_PASSES):
                system = point.system(state, key.fold(1 + index))
                state = self._next(state, system, point, _FIRST_CHANGE)
        step, moved = point.since(state.point, state)
        state = self._sharpened(state, point.theta, moved)
        state = replace(state, images=next_weight(state.images, moved)[1])
        system = point.system(state, key.fold(0), step, moved, self._needs_derivatives(point, state))
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
        if not system.is_finite():
            return estimate, before
        return estimate, self._tested(self._next(state, system, point, _CHANGE), system, point)

    def _tested(self, state: GaussNewtonState, system: System, point: Point) -> GaussNewtonState:
        """Return the state with half the widths if derivative images did not predict the change of the images since the anchor.

        Differences of that width are of another part of the images than the one that a step changes.
        """
        measured, predicted, variance = system.secant
        length = point.since(state.anchor_point, state)[1] if state.anchor else math.inf
        if predicted > 0.0 and length <= 1.0 and state.shift == self.shift:
            ratio, error = measured / predicted, math.sqrt(variance) / predicted
            wrong = abs(ratio - 1.0) > _MOST_WRONG + _SECANT_ERRORS * error
            if wrong and state.sharpness > _SHARPEST:
                widths = {key: 0.5 * width for key, width in state.widths.items()}
                state = replace(state, widths=widths, sharpness=0.5 * state.sharpness)
            elif error > _SECANT_KNOWN:
                return state
        elif length <= 1.0:
            return state
        return replace(state, anchor=tuple(system.latest), anchor_point=point.theta)

    def _needs_derivatives(self, point: Point, state: GaussNewtonState) -> bool:
        """Return whether a step has new derivative images: while the mean is of another point, shift or width, or has too much noise."""
        settled = (
            state.derivatives
            and state.shift == self.shift
            and not state.narrowed
            and point.since(state.origin, state)[1] <= _DRIFT
        )
        if not settled:
            return True
        renders = 2 * point.theta.size
        image = cost(point.problem.pixels * self.spp, 2)
        derivative = cost(point.problem.pixels * renders * self.derivative_spp, 2 * renders)
        return state.noise > self.derivative_noise or needs_derivatives(
            state.noise, state.images, state.derivatives[0].count, image, derivative
        )

    def _sharpened(self, state: GaussNewtonState, point: np.ndarray, moved: float) -> GaussNewtonState:
        """Return the state at a point, with half the shift if the last step was short relative to the widths."""
        shift = state.shift or self.coarse or self.shift
        settled = 0.0 < moved < _SETTLED
        return replace(state, shift=max(0.5 * shift, self.shift) if settled else shift, point=point)

    def _next(self, state: GaussNewtonState, system: System, point: Point, change: float) -> GaussNewtonState:
        """Return the state with updated widths, at which renders differ from the image as much as the target shift, in the root mean
        square over the elements of a parameter. Widths change by at most the factor `change`."""
        squares, slopes = (trees.parts(x, point.parameters) for x in (system.products.squares, system.slopes))
        begins = state.narrowed or not state.differenced
        widths = dict(state.widths)
        for key, width in state.widths.items() if system.fresh else ():
            square, slope = float(squares[key].mean()), float(slopes[key].mean())
            known = 0.0 < square < math.inf and 0.0 < slope < math.inf
            target = state.sharpness * state.shift * math.sqrt(slope / square) if known else width
            if square <= 0.0 < slope < math.inf:  # few samples show no small change
                target = max(width, _BLIND * (float(np.abs(arrays.numpy(point.parameters[key])).max()) or 1.0))
            widths[key] = float(np.clip(target, width / change, min(width * change, point.largest[key])))
        return replace(
            state,
            widths=widths,
            variances=tuple(system.variances) or state.variances,
            derivatives=tuple(system.derivatives) or state.derivatives,
            residuals=tuple(system.residuals),
            pictures=tuple(system.pictures),
            hessian=system.products.hessian if system.images else None,
            origin=point.theta if system.fresh else state.origin,
            differenced=state.widths if system.derivatives and begins else state.differenced,
            noise=_relative_noise(system.products.hessian, system.products.noise),
        )


def _relative_noise(hessian: np.ndarray, noise: np.ndarray) -> float:
    """Return the noise of derivative images relative to the derivatives; infinite if a direction has no positive curvature, (n, n)."""
    if scaled_eigh(hessian)[1][0] <= 0.0:
        return math.inf
    return float(np.vdot(positive_inverse(hessian), noise)) / len(hessian)
