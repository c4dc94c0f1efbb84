"""The protocol of image estimators, which estimate the image that the loss is evaluated at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.rendering.renderer import Space
from unrender.scene.batches import Frame, PixelSample
from unrender.scene.problem import Problem
from unrender.scene.sample_counts import SampleCounts


@dataclass(frozen=True)
class ImageEstimate:
    """The image of one frame at one step: of a view, (H, W, 3), or of a mini-batch of N pixels, (N, 3).

    Attributes:
        images: (groups, H, W, 3) or (groups, N, 3), one estimate per sample group, independent of the other groups' samples.
        paths: the renderer's record of the samples, for their replay.
        info: for people, e.g. {"control_weight": array}.
        previous: `images` of the previous step's parameters, from the same samples; None where they were not rendered.
        variance: of `mean()`, (H, W, 3), as far as it is known; None where it is not.
        filter: applied to an image (H, W, 3) before the loss is evaluated; None for no filter.
        fresh: the same as `images`, from this step's samples alone; None where `images` are.
        counts: how many samples each pixel has, where these differ: `images`, `previous` and `fresh` are the samples then, (1, N, 3).
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
        """The image of all samples together, (H, W, 3) or (N, 3)."""
        return self._mean(self.images)

    def previous_mean(self) -> Array:
        """`mean()` of the previous step's parameters."""
        return self._mean(self.previous)

    def others(self) -> Array:
        """Leave-one-out images: for each group, the image of all other groups' samples; its own where there is one group. With
        `counts`, for each sample that of its pixel's others."""
        return self._left_out(self.images)

    def fresh_others(self) -> Array:
        """`others()` of this step's samples alone."""
        return self._left_out(self.images if self.fresh is None else self.fresh)

    def previous_others(self) -> Array:
        """`others()` of the previous step's parameters."""
        return self._left_out(self.previous)

    def _mean(self, images: Any) -> Array:
        whole = arrays.mean_over_first(images) if self.counts is None else self.counts.means(images)
        return whole if self.filter is None else self.filter(whole)

    def _left_out(self, images: Array) -> Array:
        return self._filtered(leave_one_out(images)) if self.counts is None else self.counts.others(images)

    def _filtered(self, images: Array) -> Array:
        if self.filter is None:
            return images
        filtered = [self.filter(images[group]) for group in range(images.shape[0])]
        return arrays.concatenate([arrays.add_first_axis(image) for image in filtered])


def variance_of_mean(images: Array, counts: SampleCounts | None = None) -> Array | None:
    """The variance of the mean of independent images (groups, H, W, 3), from what they differ by; None for a single one. With `counts`,
    of the mean of each pixel's samples."""
    if counts is not None:
        return counts.variance_of_mean(images)
    groups = images.shape[0]
    if groups == 1:
        return None
    mean, square = arrays.mean_over_first(images), arrays.mean_over_first(images * images)
    return arrays.maximum(square - mean * mean, 0.0) / (groups - 1)


def leave_one_out(images: Array) -> Array:
    """Of images (groups, ...), for each group the mean of all others; the same where there is one group."""
    groups = images.shape[0]
    return images if groups == 1 else (arrays.mean_over_first(images) * groups - images) / (groups - 1)


@dataclass(frozen=True)
class PairRequest:
    """A request for the image of the previous parameters too, from the samples of the current one.

    Attributes:
        previous: the parameters of the last step that the estimator took.
        space: in which to share samples, for image estimators without a space of their own.
        step: how many steps of whole views the estimator has taken. Image estimators with a state of earlier steps require it to be their
            own count.
        batches: steps with pixel mini-batches since then: where there are any, `previous` is not of what such a state remembers.
        difference_spp: samples per pixel of further paths, on which the gradients of both states are taken, with plain images; None to
            take them on those of the images.
    """

    previous: Tree
    space: Space
    step: int = 0
    batches: int = 0
    difference_spp: int | None = None


class ImageEstimator(Protocol):
    """Immutable; all that changes is in the state."""

    @property
    def space(self) -> Space | None:
        """The space in which two states share samples; None where they do not."""
        ...

    @property
    def pixelwise(self) -> bool:
        """Whether it can estimate pixel mini-batches."""
        ...

    def init(self, problem: Problem, parameters: Tree) -> Any:
        """The state before the first step."""
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
        """The image of one frame, and its contribution to the next state; with `pair_request`, that of the previous parameters too."""
        ...

    def needs_whole_views(self, parameters: Tree, state: Any, batches: int) -> bool:
        """Whether the next step must render whole views, after `batches` steps of pixel mini-batches since the last that did."""
        ...

    def prepare(self, problem: Problem, state: Any) -> Any:
        """The state after a step that rendered whole views, prepared for pixel mini-batches."""
        ...

    def learn(self, problem: Problem, state: Any, sample: PixelSample, kept: Any) -> Any:
        """The state after a step with a mini-batch, from its contribution."""
        ...

    def advance(self, parameters: Tree, state: Any, kept: tuple[Any, ...]) -> Any:
        """The state after a step at `parameters` that rendered whole views, from the contributions of each."""
        ...
