"""Image, loss derivative and adjoint of each frame (a view or a pixel mini-batch) with leave-one-out sample groups, for one state, or
for two on one set of paths."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.estimators import emitter_selection
from unrender.estimators.emitter_selection import EmitterRequest
from unrender.estimators.gradient_sum import GradientSum, damping, smoothed_variance
from unrender.images.base import ImageEstimate, ImageEstimator, PairRequest, Plain, leave_one_out
from unrender.images.recursive_control_variate import RecursiveControlVariate, RecursiveControlVariateState
from unrender.pixels.adaptive_counts import AdaptiveCounts
from unrender.pixels.base import DrawStatistics, MiniBatch, PixelSampler
from unrender.pixels.uniform import All
from unrender.rendering.renderer import EmitterMoments, RenderSession, SampleRequest
from unrender.scene.batches import (
    Frame,
    FullView,
    ImagesOfViews,
    JoinedViews,
    PixelBatch,
    PixelSample,
    SampleCounts,
    full_views,
    joined_views,
)
from unrender.scene.problem import Problem

PIXELS = 1 << 32
"""Stream of a step's key for its pixels; lower streams are for its frames."""

TREES = ("gradient", "paired", "previous", "fresh", "noise")
"""Trees of a `GradientSample` that are summed over the frames."""

_MOST_GROUPS = 16


@dataclass(frozen=True)
class GradientSample:
    """The gradient estimate of one step's paths, over all frames.

    Attributes:
        gradient: gradient of the loss with respect to the current parameters.
        paired: the same on the paths of `previous`, if `PairRequest.difference_spp` requests separate paths; else {}.
        previous: gradient of the loss at the previous parameters, from the same paths; {} if it was not requested.
        fresh: gradient from the samples of this step alone; {} if it was not requested.
        noise: sample of the gradient's noise; {} if it was not requested, or if the number of groups is odd.
        losses: losses of the current state, one per frame, lazy.
        images: images of the current state that the loss sees, per full view.
        samples: number of paths traced for images, adjoints and the probabilities of pixels.
        info: information for people, {name: {view: array}}: of the image estimator for full views, and of the pixels' probabilities.
        image: next state of the image estimator.
        draws: statistics of the pixels of a mini-batch; None if they were not requested.
        connections: statistics of the emitter-sampling connections; None if they were not requested.
    """

    gradient: Tree
    paired: Tree
    previous: Tree
    fresh: Tree
    noise: Tree
    losses: list[Array]
    images: Mapping[int, Array]
    samples: int
    info: Mapping[str, Mapping[int, Any]]
    image: Any
    draws: DrawStatistics | None = None
    connections: EmitterMoments | None = None


@dataclass(frozen=True)
class GradientRequest:
    """A request for the loss gradient at some parameters, to be carried out by `Problem.executor`.

    With several leave-one-out groups, each group's adjoint is weighted by the loss derivative at the image of all other groups
    (`PathGradient`). A single group traces `adjoint_spp` separate paths for the adjoint.

    Attributes:
        image, state: Image estimator and its state. The state advances where full views are rendered.
        spp: Samples per pixel of the image.
        key: Random numbers of the step.
        adjoint_spp: Samples per pixel of the adjoint if it has paths of its own; None for `spp` where there is one group.
        pair_request: Requests the gradient of the previous state, on the same paths and weighted by its own images. With its
            `difference_spp` both are on separate paths, weighted by the images of all groups, which are independent of them.
        batch: Pixel mini-batch, rendered in one launch for all views; None for full views.
        tolerance: See `PathGradient`.
        fresh: Whether to add the gradient from this step's samples alone.
        noise: Whether to add a sample of the gradient's noise.
        emitters: Selection probabilities of emitters; None for the scene's own.
    """

    parameters: Tree
    image: ImageEstimator
    state: Any
    spp: int
    key: Key
    adjoint_spp: int | None = None
    pair_request: PairRequest | None = None
    batch: MiniBatch | None = None
    tolerance: float = 0.0
    fresh: bool = False
    noise: bool = False
    emitters: EmitterRequest | None = None

    @property
    def tangents(self) -> Tree:
        """Tangents for the squared derivatives of the pixels; {} for none. They are not available for pairs of mini-batches."""
        if self.batch is None or (self.pair_request is not None and self.batch.shares is None):
            return {}
        return self.batch.tangents

    def begin(self, problem: Problem) -> GatheredFrames:
        """Return the frames of the step, before the estimation of their contributions."""
        sample, shares = (self.batch.sample, self.batch.shares) if self.batch else (None, None)
        likely = None if self.emitters is None else self.emitters.probabilities
        frames: Sequence[Frame] = [PixelBatch(problem, sample, likely)] if sample is not None else ()
        frames = frames or self._joined_views(problem) or full_views(problem, shares, self.spp, likely)
        return GatheredFrames(self, frames)

    def _joined_views(self, problem: Problem) -> list[JoinedViews]:
        """Return frames of several views; [] if the request does not support them, or if the state is that of single views."""
        shares = self.batch.shares if self.batch else None
        known = isinstance(self.image, (Plain, RecursiveControlVariate))
        one_set = leave_one_out_groups(self.spp, self.adjoint_spp) > 1 and self.pair_request is None
        if not (known and one_set) or shares is not None or self.emitters is not None:
            return []
        frames = joined_views(problem, self.spp, self.key)
        views = self.state.views if isinstance(self.state, RecursiveControlVariateState) else ()
        return frames if len(views) in (0, len(frames)) else []

    def estimate_frame(self, problem: Problem, frame: Frame, key: Key) -> FrameGradient:
        """Return the contribution of one frame, computed in this process. `key` is the random key of the frame."""
        parameters, spp, adjoint_spp, pair_request = self.parameters, self.spp, self.adjoint_spp, self.pair_request
        difference_spp = pair_request.difference_spp if pair_request else None
        # the pair whose gradients use the paths of the images
        on_images = pair_request if difference_spp is None else None
        groups = leave_one_out_groups(spp, adjoint_spp)
        session = problem.renderer.prepare(list(parameters), pair_request.space if pair_request else None)
        image_estimate, contribution = self.image.estimate(
            problem, parameters, self.state, frame, spp, groups, key.fold(0), pair_request
        )
        mean = image_estimate.mean()
        loss = frame.loss_value(mean)
        paths, traced = image_estimate.paths, spp
        counts = frame.counts if isinstance(frame, FullView) else None
        if groups == 1 and counts is None:
            samples = frame.request(adjoint_spp or spp, key.fold(1).uint32())
            paths = _paths(session, parameters, samples, on_images)
            traced += samples.spp
        derivative = _derivative(problem, frame, image_estimate.variance, self.tolerance)
        others = image_estimate.others()
        weights = derivative(others)
        paired: Tree = {}
        previous: Tree = {}
        if on_images is None:
            gradient = session.adjoint(parameters, paths, weights)
        else:
            weights_previous = derivative(image_estimate.previous_others())
            gradient, previous = session.adjoint_pair(parameters, on_images.previous, paths, weights, weights_previous)
        if pair_request is not None and difference_spp is not None:
            samples = frame.request(difference_spp, key.fold(2).uint32())
            both = (derivative(arrays.add_first_axis(image)) for image in (mean, image_estimate.previous_mean()))
            further = _paths(session, parameters, samples, pair_request)
            paired, previous = session.adjoint_pair(parameters, pair_request.previous, further, *both)
            traced += difference_spp
        fresh: Tree = {}
        if self.fresh and image_estimate.fresh is not None:
            fresh = session.adjoint(parameters, paths, fresh_weights(problem, frame, image_estimate, others, weights))
        noise: Tree = {}
        if self.noise and counts is None and groups % 2 == 0:
            noise = session.adjoint(
                parameters, paths, _noise_weights(derivative, image_estimate.images, others, weights)
            )
        draws = None
        if self.tangents and isinstance(frame, PixelBatch):
            draws = _draw_statistics(frame, weights, session.tangent_moment(parameters, paths, self.tangents))
        elif self.tangents and counts is not None:
            draws = _view_statistics(counts, weights, session.tangent_moment(parameters, paths, self.tangents))
        connections = None
        if self.emitters is not None and self.emitters.tangents:
            connections = emitter_selection.connections(
                session, parameters, self.emitters.tangents, image_estimate, weights, spp
            )
        pixels = traced * frame.pixels
        trees, info = (gradient, paired, previous, fresh, noise), image_estimate.info
        return FrameGradient(*trees, loss, mean, pixels, info, contribution, draws, connections)


class GatheredFrames:
    """The contributions of the frames of a step: gradients are summed in the order of arrival.

    Args:
        frames: the frames, in the order of their contributions.
    """

    def __init__(self, request: GradientRequest, frames: Sequence[Frame]):
        self.frames = frames
        self._request = request
        self._sums = {name: GradientSum() for name in TREES}
        self._parts: list[FrameGradient] = []

    def add(self, part: FrameGradient) -> None:
        """Add the contribution of the next frame."""
        for name, total in self._sums.items():
            total.add(getattr(part, name))
        self._parts.append(replace(part, **{name: {} for name in TREES}))

    def result(self, problem: Problem) -> GradientSample:
        """Return the estimate of all frames."""
        batch, parts = self._request.batch, self._parts
        info: dict[str, Any] = {"pixel_probability": batch.probability} if batch and batch.probability else {}
        images: dict[int, Array] = {}
        joined: dict[str, list[tuple[JoinedViews, Array]]] = {}
        for frame, part in zip(self.frames, parts, strict=True):
            if isinstance(frame, FullView):
                images[frame.view] = part.image
                for name, value in part.info.items():
                    info.setdefault(name, {})[frame.view] = value
            elif isinstance(frame, JoinedViews):
                for name, value in {"images": part.image, **part.info}.items():
                    joined.setdefault(name, []).append((frame, value))
        shown = {name: ImagesOfViews(of) for name, of in joined.items()}
        connections = [part.connections for part in parts if part.connections is not None]
        return GradientSample(
            **{name: total.result() for name, total in self._sums.items()},
            losses=[part.loss for part in parts],
            images=shown.pop("images", images),
            samples=(batch.samples if batch else 0) + sum(part.samples for part in parts),
            info=info | shown,
            image=_image_state(problem, self._request, batch.sample if batch else None, parts),
            draws=_concatenated([part.draws for part in parts if part.draws is not None]),
            connections=functools.reduce(operator.add, connections) if connections else None,
        )


def leave_one_out_groups(spp: int, adjoint_spp: int | None = None) -> int:
    """Return the number of groups that `spp` samples are divided into; 1 if they cannot be divided, or if the adjoint has separate
    paths."""
    return 1 if adjoint_spp is not None else max(n for n in range(1, _MOST_GROUPS + 1) if spp % n == 0)


def draws_pixels(pixels: PixelSampler) -> bool:
    """Return whether a pixel sampler has mini-batches; the others render full views at each step."""
    return not isinstance(pixels, (All, AdaptiveCounts))


def check_pixels(owner: str, pixels: Any, image: ImageEstimator, fewest: int, adjoint_spp: int | None = None) -> None:
    """Raise `InputError` for mini-batches or sample counts that the image estimator does not support, or for fewer than `fewest` samples
    per pixel of any gradient of a step."""
    if not isinstance(pixels, All) and not image.pixelwise:
        raise InputError(f"{owner}: {type(image).__name__} needs full views; use pixels=unrender.pixels.All()")
    if isinstance(image, RecursiveControlVariate) and not draws_pixels(pixels):
        checks.without_effect(image, ("whole_views", "learn_from_draws"), "pixel mini-batches, such as Uniform(4096)")
    if not isinstance(pixels, AdaptiveCounts):
        return
    if adjoint_spp is not None:
        raise InputError(f"{owner}: AdaptiveCounts uses the image's paths for the adjoint; leave out adjoint_spp")
    if fewest <= pixels.least:
        raise InputError(
            f"{owner}: spp must be at least {pixels.least + 1}, got {fewest}; AdaptiveCounts takes {pixels.least} samples in each "
            "pixel and more in some"
        )


def _image_state(
    problem: Problem, request: GradientRequest, sample: PixelSample | None, parts: list[FrameGradient]
) -> Any:
    image, state = request.image, request.state
    if sample is not None:
        return image.learn(problem, state, sample, parts[0].image_state)
    return image.advance(request.parameters, state, tuple(part.image_state for part in parts))


def _concatenated(draws: list[DrawStatistics]) -> DrawStatistics | None:
    if len(draws) <= 1:
        return draws[0] if draws else None
    squares, moments = (np.concatenate([getattr(part, name) for part in draws]) for name in ("squares", "moments"))
    return DrawStatistics(squares, moments, np.concatenate([part.counts for part in draws if part.counts is not None]))


@dataclass(frozen=True)
class FrameGradient:
    """Contribution of one frame to a `GradientSample`. `image_state` is its contribution to the image estimator's next state."""

    gradient: Tree
    paired: Tree
    previous: Tree
    fresh: Tree
    noise: Tree
    loss: Array
    image: Array
    samples: int
    info: Mapping[str, Any]
    image_state: Any
    draws: DrawStatistics | None = None
    connections: EmitterMoments | None = None


def _draw_statistics(frame: PixelBatch, weights: Array, moments: Array) -> DrawStatistics:
    """Return the statistics from the weights of the adjoint (groups, N, 3) and the squared derivatives of its paths, of the same shape
    or of one group (N, 3).

    Each is unbiased; their product is not, since the weights of one group come from the paths of another.
    """
    arrays.evaluate(weights, moments)
    derivative, of_draw = arrays.numpy(weights).astype(np.float64), arrays.numpy(frame.sample.weights)
    derivative = np.divide(derivative, of_draw, out=np.zeros_like(derivative), where=of_draw != 0)
    squares = np.square(derivative).mean(axis=0)
    return DrawStatistics(squares, arrays.numpy(moments).astype(np.float64).reshape(-1, *squares.shape).mean(axis=0))


def _view_statistics(counts: SampleCounts, weights: Array, moments: Array) -> DrawStatistics:
    """Return the statistics of a full view, from the weights of its samples (1, N, 3), and their squared derivatives (N, 3)."""
    derivative = weights * counts.spread(counts.divisors)
    means = [arrays.rows(counts.means(x)) for x in (derivative * derivative, moments)]
    arrays.evaluate(means)
    squares, moments = (arrays.numpy(x).astype(np.float64) for x in means)
    return DrawStatistics(squares, moments, arrays.numpy(counts.numbers).astype(np.float64))


def _derivative(problem: Problem, frame: Frame, variance: Array | None, tolerance: float) -> Callable[[Array], Array]:
    """Return the loss derivative of a frame's images, damped if the loss is biased by noise and the variance of the image is known."""
    loss = problem.loss
    if variance is None or not tolerance or loss.linear or not loss.pixelwise:
        return frame.loss_derivative
    match frame:
        case FullView():
            around, reference = (frame.expand(x) for x in (smoothed_variance(variance), problem.reference(frame.view)))
        case PixelBatch(complete_views=complete) if complete:
            around, reference = smoothed_variance(variance, complete), frame.targets[0]
        case _:
            return frame.loss_derivative
    return lambda images: frame.loss_derivative(images) * damping(images - reference, around, tolerance)


def _noise_weights(derivative: Callable[[Array], Array], images: Array, others: Array, weights: Array) -> Array:
    """Return weights of the adjoint whose gradient has mean 0 and about the variance of the gradient.

    Every other group has the opposite sign. All groups have the same expectation, so the gradient is the noise of the paths. That of the
    leave-one-out images is in the difference of their derivative: images with alternating signs, without their mean, are added.

    Args:
        images, others: images of the groups, an even number, and leave-one-out images.
        weights: loss derivative at `others`.
    """
    groups = arrays.shape(images)[0]
    signs = arrays.like((-1.0) ** np.arange(groups).reshape(-1, *(1,) * (images.ndim - 1)), images)
    signed = signs * images
    noise = (arrays.mean_over_first(signed) * groups - signed + signs * leave_one_out(images)) / (groups - 1)
    return derivative(others + noise) + (signs - 1.0) * weights


def fresh_weights(problem: Problem, frame: Frame, image: ImageEstimate, others: Array, weights: Array) -> Array:
    """Return the loss derivative at this step's samples alone.

    If the derivative is not linear, it is taken along the secant at the image that the loss sees, since L1's own would be the sign of the
    noise. `weights`, that at the leave-one-out images, must then be damped (`tolerance`), since the secant would be unbounded.
    """
    fresh = image.fresh_others()
    if problem.loss.linear or not isinstance(frame, (FullView, JoinedViews)):
        return frame.loss_derivative(fresh)
    full = isinstance(frame, FullView)
    reference = frame.expand(problem.reference(frame.view)) if full else frame.targets[0]
    residual = others - reference
    square = residual * residual
    return weights * residual * (fresh - reference) / (square + 1e-12)


def _paths(session: RenderSession, parameters: Tree, request: SampleRequest, pair_request: PairRequest | None) -> Any:
    if pair_request is None:
        return session.image(parameters, request).paths
    request = replace(request, both_gradients=True)
    return session.image_pair(parameters, pair_request.previous, request, pair_request.space).paths
