"""Protocol of image estimators, which estimate the image at which the loss is evaluated, and plain Monte Carlo."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.rendering.renderer import Space
from unrender.scene.batches import Frame, FullView, PixelSample, SampleCounts
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Unchanged


@dataclass(frozen=True)
class ImageEstimate:
    """Image of one frame at one step: of a view, (H, W, 3), or of a mini-batch of N pixels, (N, 3).

    Attributes:
        images: (groups, H, W, 3) or (groups, N, 3), one estimate per sample group, independent of the other groups' samples.
        paths: the renderer's record of the samples, for replay.
        info: arrays for display, e.g. {"control_weight": array}.
        previous: `images` at the previous step's parameters, from the same samples; None if not rendered.
        variance: variance of `mean()`, (H, W, 3); None if unknown.
        filter: function of an image (H, W, 3) that is applied before the loss is evaluated; None for no filter.
        fresh: `images` from this step's samples only; None if `images` already are.
        counts: number of samples of each pixel, if they differ. `images`, `previous` and `fresh` are then single samples, (1, N, 3).
    """

    images: Array
    paths: Any
    info: Mapping[str, Any] = field(default_factory=dict)
    previous: Array | None = None
    variance: Array | None = None
    filter: Callable[[Array], Array] | None = None
    fresh: Array | None = None
    counts: SampleCounts | None = None

    def mean(self) -> Array:
        """Return the image from all samples, filtered, (H, W, 3) or (N, 3)."""
        return self._mean(self.images)

    def previous_mean(self) -> Array:
        """Return `mean()` at the previous step's parameters. Requires `previous`."""
        return self._mean(self.previous)

    def others(self) -> Array:
        """Return the leave-one-out images, filtered: for each group the image from all other groups, or its own if there is only one.

        With `counts`, return for each sample the image from the other samples of its pixel.
        """
        return self._left_out(self.images)

    def fresh_others(self) -> Array:
        """Return `others()` from this step's samples only."""
        return self._left_out(self.images if self.fresh is None else self.fresh)

    def previous_others(self) -> Array:
        """Return `others()` at the previous step's parameters. Requires `previous`."""
        return self._left_out(self.previous)

    def _mean(self, images: Any) -> Array:
        mean = arrays.mean_over_first(images) if self.counts is None else self.counts.means(images)
        return mean if self.filter is None else self.filter(mean)

    def _left_out(self, images: Array) -> Array:
        return self._filtered(leave_one_out(images)) if self.counts is None else self.counts.others(images)

    def _filtered(self, images: Array) -> Array:
        if self.filter is None:
            return images
        filtered = [self.filter(images[group]) for group in range(images.shape[0])]
        return arrays.concatenate([arrays.add_first_axis(image) for image in filtered])


def variance_of_mean(images: Array, counts: SampleCounts | None = None) -> Array | None:
    """Return the variance of the mean of independent images (groups, H, W, 3), from their spread; None for a single group.

    With `counts`, return the variance of the mean of each pixel's samples.
    """
    if counts is not None:
        return counts.variance_of_mean(images)
    groups = images.shape[0]
    if groups == 1:
        return None
    mean, square = arrays.mean_over_first(images), arrays.mean_over_first(images * images)
    return arrays.maximum(square - mean * mean, 0.0) / (groups - 1)


def leave_one_out(images: Array) -> Array:
    """Return, for each of the images (groups, ...), the mean of the others; the image itself if there is one group."""
    groups = images.shape[0]
    return images if groups == 1 else (arrays.mean_over_first(images) * groups - images) / (groups - 1)


@dataclass(frozen=True)
class PairRequest:
    """Request for the image at the previous parameters too, from the samples of the current one.

    Attributes:
        previous: parameters of the estimator's last step.
        space: space in which samples are shared, for image estimators without their own.
        step: number of steps of full views that the estimator has taken. Image estimators with a state require that it equals their own
            count.
        batches: number of later steps with pixel mini-batches. If it is not 0, the state of an image estimator is older than `previous`.
        difference_spp: samples per pixel of additional paths, on which the gradients of both states are computed with plain images. None
            computes them on the paths of the images.
    """

    previous: Tree
    space: Space
    step: int = 0
    batches: int = 0
    difference_spp: int | None = None


_RENAMED = "ImageEstimator.needs_whole_views is now needs_full_views"


def needs_whole_views(self: ImageEstimator, parameters: Tree, state: Any, batches: int) -> bool:
    """Former name of `needs_full_views`, as a method. Version 0.2 removes it."""
    warnings.warn(_RENAMED, DeprecationWarning, stacklevel=2)
    return self.needs_full_views(parameters, state, batches)


class WithoutSnapshot:
    """Base of image estimators that prepare and learn nothing for pixel mini-batches."""

    needs_whole_views = needs_whole_views

    def prepare(self, problem: Problem, state: Any) -> Any:
        return state

    def learn(self, problem: Problem, state: Any, sample: PixelSample, contribution: Any) -> Any:
        return state


class ImageEstimator(Protocol):
    """Immutable image estimator; everything that changes is in the state."""

    @property
    def space(self) -> Space | None:
        """Space in which two states share samples; None if they share none."""
        ...

    @property
    def pixelwise(self) -> bool:
        """Return whether pixel mini-batches can be estimated."""
        ...

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """Return the state before the first step."""
        ...

    def estimate(
        self,
        problem: Problem,
        parameters: Tree,
        state: Any,
        frame: Frame,
        spp: int,
        groups: int,
        key: Key,
        pair_request: PairRequest | None = None,
    ) -> tuple[ImageEstimate, Any]:
        """Return the image of one frame and its contribution to the next state; with `pair_request`, also the image at the previous
        parameters."""
        ...

    def needs_full_views(self, parameters: Tree, state: Any, batches: int) -> bool:
        """Return whether the next step must render full views, after `batches` steps with mini-batches since the last full one."""
        ...

    def prepare(self, problem: Problem, state: Any) -> Any:
        """Return the state after a step of full views, prepared for pixel mini-batches."""
        ...

    def learn(self, problem: Problem, state: Any, sample: PixelSample, contribution: Any) -> Any:
        """Return the state after a step with a mini-batch, from its contribution."""
        ...

    def advance(self, parameters: Tree, state: Any, contributions: tuple[Any, ...]) -> Any:
        """Return the state after a step of full views at `parameters`, from the contribution of each view."""
        ...


def needs_full_views(image: ImageEstimator, parameters: Tree, state: Any, batches: int) -> bool:
    """Return `image.needs_full_views(...)`, or the result of its former name `needs_whole_views`, which version 0.2 ignores."""
    inherited = (None, ImageEstimator.needs_full_views)
    former = getattr(image, "needs_whole_views", None)
    if former is None or getattr(type(image), "needs_full_views", None) not in inherited:
        return image.needs_full_views(parameters, state, batches)
    warnings.warn(_RENAMED, DeprecationWarning, stacklevel=2)
    return former(parameters, state, batches)


@dataclass(frozen=True)
class PlainState(Unchanged):
    """Empty state."""


@register
@dataclass(frozen=True)
class Plain(WithoutSnapshot):
    """One independent rendering per step. Unbiased."""

    space, pixelwise = None, True

    def init(self, problem: Problem, parameters: Tree) -> PlainState:
        return PlainState()

    def estimate(
        self,
        problem: Problem,
        parameters: Tree,
        state: PlainState,
        frame: Frame,
        spp: int,
        groups: int,
        key: Key,
        pair_request: PairRequest | None = None,
    ) -> tuple[ImageEstimate, None]:
        request = frame.request(spp, key.uint32(), groups)
        if pair_request is None:
            rendering = problem.renderer.prepare(list(parameters), None).image(parameters, request)
        else:
            session = problem.renderer.prepare(list(parameters), pair_request.space)
            request = replace(request, both_gradients=pair_request.difference_spp is None)
            rendering = session.image_pair(parameters, pair_request.previous, request, pair_request.space)
        counts = frame.counts if isinstance(frame, FullView) else None
        variance = variance_of_mean(rendering.images, counts)
        return ImageEstimate(rendering.images, rendering.paths, {}, rendering.previous, variance, counts=counts), None

    def needs_full_views(self, parameters: Tree, state: PlainState, batches: int) -> bool:
        return False

    def advance(self, parameters: Tree, state: PlainState, contributions: tuple[Any, ...]) -> PlainState:
        return state
