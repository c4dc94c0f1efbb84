"""Recursive control variates: an image that keeps what earlier steps rendered.

Nicolet et al. 2023, "Recursive Control Variates for Inverse Rendering".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender import statistics
from unrender.core import arrays, checks, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimate, PairRequest, variance_of_mean
from unrender.rendering.renderer import Rendering, Space
from unrender.scene.batches import Frame, PixelBatch, PixelSample, WholeView
from unrender.scene.problem import Problem
from unrender.scene.sample_counts import SampleCounts
from unrender.scene.upsampling import Upsampler
from unrender.statistics import welford
from unrender.statistics.recursion import advance

_MOST_PIXELS = 64
"""Of all views for each of a mini-batch's, for its samples to be remembered: to add them takes time by the number of all."""


@dataclass(frozen=True)
class ViewMemory:
    """The control variate of one view and its statistics; every array (H, W, 3).

    Attributes:
        image: the control variate ⟨F_n⟩_CV.
        relative_variance: of `image`, in units of one step's ⟨F_n⟩_n, by the recurrence (10); in units of one sample's, where pixels
            have different numbers of samples.
        variance: of `image`, by the recurrence in absolute units; 0 before there are statistics.
        current, previous, joint: running statistics of ⟨F_n⟩_n, of ⟨F_{n-1}⟩_n, and of both; of one sample's, likewise.
    """

    image: Array
    relative_variance: Array
    variance: Array
    current: welford.State
    previous: welford.State
    joint: welford.State


@dataclass(frozen=True)
class Snapshot:
    """The control variate that pixel mini-batches use: the pixels of all views, concatenated, (P, 3) each.

    Attributes:
        image: the control variate.
        weight: w of each pixel, from the statistics at the time of the snapshot.
        relative_variance: of `image`; see `ViewMemory`.
    """

    image: Array
    weight: Array
    relative_variance: Array


@dataclass(frozen=True)
class RecursiveControlVariateState:
    """State between steps.

    Attributes:
        parameters: of the last step that rendered whole views; None before the first.
        views: control variate and statistics of each view; empty before the first step.
        snapshot: the same for pixel mini-batches; None without them.
        step: how many steps rendered whole views; with `PairRequest.step`, says whether two states are of the same step.
    """

    parameters: Tree | None = None
    views: tuple[ViewMemory, ...] = ()
    snapshot: Snapshot | None = None
    step: int = 0

    def upsampled(self, upsampler: Upsampler) -> RecursiveControlVariateState:
        """See `Upsamplable`: the previous parameters are interpolated, images stay."""
        return self if self.parameters is None else replace(self, parameters=upsampler.tree(self.parameters))

    def remembered(self) -> tuple[Tree, tuple[Array, ...]] | None:
        """Return the parameters of the control variates, and the control variate of each view; None before the first step."""
        return None if self.parameters is None else (self.parameters, tuple(memory.image for memory in self.views))


@register
@dataclass(frozen=True)
class RecursiveControlVariate:
    """⟨F_n⟩_CV = ⟨F_n⟩_n + w_n (⟨F_{n-1}⟩_CV − ⟨F_{n-1}⟩_n), Eq. 6, per view, pixel and colour channel.

    The weight (Eq. 8) comes from statistics of earlier steps only: they are updated after use, which leaves the small bias
    that section 3.2 of the paper describes (the weight still knows the samples inside ⟨F_{n-1}⟩_CV). Consistent: with
    unchanging parameters the image converges to the exact one.

    Args:
        space: "path" shares paths between the two states (one trace; materials and emitters), and relates those of meshes that move
            (two traces); "primary" shares random numbers (two traces; any parameter, less correlation).
        alpha: decay of the running means, in [0, 1).
        beta: decay of the running (co)variances, in [0, 1).
        whole_views: with pixel mini-batches, every so many of them are followed by a step that renders whole views, >= 1.
        learn_from_draws: remember what mini-batches render, too, not whole views alone.
        max_weight: upper bound of the weights, in (0, 1]; 1 in the paper. Below, an error of the image is forgotten after some
            1 / (1 - max_weight) steps. With 1, it lasts as long as the run has lasted, an optimizer takes it for signal, and
            follows: where rare bright paths make most of the noise, the parameters get worse again.

    With pixel mini-batches the control variate is a snapshot, since pixels outside the batch are not updated: a step that renders whole
    views updates image and statistics, and until the next one each mini-batch uses ⟨F_n⟩ + w (⟨F_s⟩_CV − ⟨F_s⟩_n) against that
    step s. Steps of whole views have their full cost; large images afford few. What a mini-batch renders of the state of step s is
    independent of ⟨F_s⟩_CV: after use both are averaged, by their variances (`learn_from_draws`). Not where a mini-batch has less than
    a 64th of all pixels, or views are dealt to workers.

    The state starts anew when a parameter changes its shape.

    Var[⟨F_n⟩_CV] is the greater of two recurrences (10). One is relative to Var[⟨F_n⟩_n], to which (10) is invariant: an absolute value
    freezes the first, worst estimate of the variance, and a pixel whose first samples happen to agree has variance 0 and weight 1, and
    keeps its first value for ever. The other is absolute: a relative value follows Var[⟨F_n⟩_n] where parameters move, which the error
    of the image does not. Where the two states have always agreed, as in pixels that show nothing unknown, the relative one alone is
    exact, and images are averaged.

    Where the sample variance is still zero, at the first steps or in a pixel that has only been black, the two states count as fully
    correlated: the weight is 1 / (1 + r) for the relative variance r, which becomes r / (1 + r), so that images are averaged. A weight
    of 0 would discard the black samples at the first bright one, and leave the pixel too bright.
    """

    space: Space = "path"
    alpha: float = 0.9
    beta: float = 0.999
    whole_views: int = 20
    learn_from_draws: bool = True
    max_weight: float = 1.0

    def __post_init__(self):
        checks.integer("RecursiveControlVariate", "whole_views", self.whole_views, at_least=1)
        if self.space not in ("path", "primary"):
            raise InputError(f'RecursiveControlVariate: space must be "path" or "primary", got {self.space!r}')
        for name in ("alpha", "beta"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"RecursiveControlVariate: {name} must be in [0, 1), got {getattr(self, name)!r}")
        if not checks.number("RecursiveControlVariate", "max_weight", self.max_weight, above=0.0) <= 1:
            raise InputError(f"RecursiveControlVariate: max_weight must be in (0, 1], got {self.max_weight!r}")

    def init(self, problem: Problem, parameters: Tree) -> RecursiveControlVariateState:
        del problem, parameters
        return RecursiveControlVariateState()

    @property
    def pixelwise(self) -> bool:
        """True: from a snapshot."""
        return True

    def needs_whole_views(self, parameters: Tree, state: RecursiveControlVariateState, batches: int) -> bool:
        """At the first step, when shapes change, and after every `whole_views` mini-batches."""
        return batches >= self.whole_views or self._is_first(parameters, state)

    def prepare(self, problem: Problem, state: RecursiveControlVariateState) -> RecursiveControlVariateState:
        del problem
        parts = [(memory.image, self._weight(memory), memory.relative_variance) for memory in state.views]
        return replace(
            state, snapshot=Snapshot(*(arrays.concatenate([arrays.rows(part[n]) for part in parts]) for n in range(3)))
        )

    def learn(
        self, problem: Problem, state: RecursiveControlVariateState, sample: PixelSample, kept: Array | None
    ) -> RecursiveControlVariateState:
        """See `ImageEstimator.learn`: the image of the snapshot, at its own parameters, with the mini-batch's renders at these.

        A pixel that was drawn k times, with the mean H of these, and whose image has the relative variance r: it becomes the mean of least
        variance of both, image + r k / (1 + r k) (H - image), and r becomes r / (1 + r k). Its weight follows.
        """
        snapshot = state.snapshot
        if not self.learn_from_draws or kept is None or snapshot is None:
            return state
        count = int(arrays.shape(snapshot.image)[0])
        if count > _MOST_PIXELS * int(arrays.shape(kept)[0]):
            return state
        row = arrays.numpy(problem.references.rows(sample.views, sample.pixels)).astype(np.int64)
        order = np.argsort(row, kind="stable")
        drawn, starts, numbers = np.unique(row[order], return_index=True, return_counts=True)
        sums = arrays.segment_sums(
            arrays.gather_rows(kept, arrays.like_integers(order, kept)),
            arrays.like_integers(starts, kept),
            arrays.like_integers(numbers, kept),
        )
        times = arrays.like(np.repeat(numbers[:, None], 3, axis=1).astype(np.float32), kept)
        where = arrays.like_integers(drawn, kept)
        total, number = (arrays.add_rows(x, where, count) for x in (sums, times))
        past = snapshot.relative_variance
        after = past / (1.0 + past * number)
        image = snapshot.image + after * (total - number * snapshot.image)
        weight = arrays.minimum(snapshot.weight * (1.0 + past) / (1.0 + after), self.max_weight)
        return replace(state, snapshot=Snapshot(image, weight, after))

    def _learnt(self, state: RecursiveControlVariateState, view: int) -> ViewMemory:
        """A view's memory, with what mini-batches have told since."""
        memory, snapshot = state.views[view], state.snapshot
        if snapshot is None or not self.learn_from_draws:
            return memory
        sizes = [arrays.shape(other.image) for other in state.views]
        first = sum(math.prod(size[:2]) for size in sizes[:view])
        rows = slice(first, first + math.prod(sizes[view][:2]))
        image, relative = (arrays.reshape(x[rows], sizes[view]) for x in (snapshot.image, snapshot.relative_variance))
        known = memory.relative_variance > 0
        shrunk = arrays.where(known, relative / arrays.where(known, memory.relative_variance, 1.0), 1.0)
        return replace(memory, image=image, relative_variance=relative, variance=shrunk * memory.variance)

    def estimate(
        self,
        problem: Problem,
        parameters: Tree,
        state: RecursiveControlVariateState,
        frame: Frame,
        spp: int,
        groups: int,
        key: Key,
        pair_request: PairRequest | None = None,
    ) -> tuple[ImageEstimate, ViewMemory | Array]:
        """See `ImageEstimator.estimate`. Group g's image takes F and H from group g's samples alone.

        The previous state is always rendered, in the own space; its image H + w (⟨F_{n-1}⟩_CV − H) has the error of the current
        one as far as the two can share it: they differ by F − H. Where the control variate is a snapshot of an earlier step s, and the
        pair requested of a later one, that is rendered from the same random numbers, too: P + w (⟨F_s⟩_CV − H) for its image P.

        Raises:
            InputError: the pair requested is not of the step of the control variate, or a mini-batch comes before whole views.
        """
        first = self._is_first(parameters, state)
        if pair_request is not None and pair_request.step != state.step:
            raise InputError(
                f"RecursiveControlVariate: its state is of step {state.step}, the pair requested of step {pair_request.step}"
            )
        previous = parameters if first or state.parameters is None else state.parameters
        request = replace(frame.request(spp, key.uint32(), groups), both_gradients=pair_request is not None)
        session = problem.renderer.prepare(list(parameters), self.space)
        rendering = session.image_pair(parameters, previous, request, self.space)
        asked = rendering
        if pair_request is not None and pair_request.batches:
            asked = session.image_pair(parameters, pair_request.previous, request, self.space)
        match frame:
            case PixelBatch():
                if first or state.snapshot is None:
                    raise InputError("RecursiveControlVariate: a pixel mini-batch needs an earlier step of whole views")
                told = arrays.mean_over_first(rendering.previous)
                return self._combine_pixels(problem, state.snapshot, frame, rendering, asked), told
            case WholeView():
                if first:
                    images, previous_images, counts = rendering.images, rendering.previous, frame.counts
                    variance = variance_of_mean(images, counts)
                    estimate = ImageEstimate(images, rendering.paths, {}, previous_images, variance, counts=counts)
                    return estimate, self._start(estimate.mean(), counts)
                return self._combine_view(self._learnt(state, frame.view), rendering, asked, frame)
        raise InputError(f"RecursiveControlVariate: expected a whole view or a pixel mini-batch, got {frame!r}")

    @staticmethod
    def _combine_pixels(
        problem: Problem, snapshot: Snapshot, frame: PixelBatch, rendering: Rendering, asked: Rendering
    ) -> ImageEstimate:
        """Both images of a mini-batch, (groups, N, 3), with the snapshot as control variate; the previous one is that of `asked`."""
        row = problem.references.rows(frame.sample.views, frame.sample.pixels)
        image, weight, past = (
            arrays.gather_rows(x, row) for x in (snapshot.image, snapshot.weight, snapshot.relative_variance)
        )
        current = advance(image, rendering.images, rendering.previous, weight)
        previous = advance(image, asked.previous, rendering.previous, weight)
        variance = variance_of_mean(current)
        if variance is not None:
            variance = variance + weight * weight * past * variance_of_mean(rendering.previous)
        return ImageEstimate(current, asked.paths, previous=previous, variance=variance)

    def _combine_view(
        self, memory: ViewMemory, rendering: Rendering, asked: Rendering, frame: WholeView
    ) -> tuple[ImageEstimate, ViewMemory]:
        """Both images of a view, (groups, H, W, 3) or samples (1, N, 3), and the view's memory after the step; the previous image is that
        of `asked`."""
        counts = frame.counts
        number: Array | float = 1.0 if counts is None else counts.divisors
        mean = arrays.mean_over_first if counts is None else counts.means
        F, H = mean(rendering.images), mean(rendering.previous)
        past, weight = memory.relative_variance, self._weight(memory, number)
        image, of_each = frame.expand(memory.image), frame.expand(weight)
        current = advance(image, rendering.images, rendering.previous, of_each)
        observed = self._observe(memory, F, H, number)
        var_current, var_previous = welford.covariance(observed.current), welford.covariance(observed.previous)
        cov = welford.covariance(observed.joint)
        variance = statistics.control_variate_variance(
            weight, var_current / number, var_previous / number, cov / number, past * var_previous
        )
        known = var_current > 0
        averaged = weight * weight * past + (1.0 - weight) * (1.0 - weight) / number
        relative = arrays.where(known, variance / arrays.where(known, var_current, 1.0), averaged)
        begun = memory.variance > 0
        absolute = statistics.control_variate_variance(
            weight,
            var_current / number,
            var_previous / number,
            cov / number,
            arrays.where(begun, memory.variance, past * var_previous),
        )
        moved = ((cov != var_previous) | (cov != var_current)) & (var_previous > 0)
        variance = relative * var_current
        variance = arrays.where(moved, arrays.maximum(variance, absolute), variance)
        of_absolute = absolute / arrays.where(moved, var_previous, 1.0)
        relative = arrays.where(moved, arrays.maximum(relative, of_absolute), relative)
        info = {"control_weight": weight, "variance": variance}
        previous = advance(image, asked.previous, rendering.previous, of_each)
        if (within := variance_of_mean(rendering.images, counts)) is not None:
            variance = arrays.where(known, variance, relative * number * within)
        estimate = ImageEstimate(current, asked.paths, info, previous, variance, fresh=rendering.images, counts=counts)
        return estimate, replace(observed, image=estimate.mean(), relative_variance=relative, variance=absolute)

    def advance(
        self, parameters: Tree, state: RecursiveControlVariateState, kept: tuple[Any, ...]
    ) -> RecursiveControlVariateState:
        return RecursiveControlVariateState(parameters, kept, step=state.step + 1)

    def _is_first(self, parameters: Tree, state: RecursiveControlVariateState) -> bool:
        return state.parameters is None or trees.shapes(state.parameters) != trees.shapes(parameters)

    def _weight(self, memory: ViewMemory, number: Array | float = 1.0) -> Array:
        """Where one step has so many samples of those that the statistics are of."""
        var_previous, past = welford.covariance(memory.previous), memory.relative_variance * number
        best = arrays.where(
            var_previous > 0,
            statistics.control_weight(welford.covariance(memory.joint), var_previous, past * var_previous),
            1.0 / (1.0 + past),
        )
        return arrays.minimum(best, self.max_weight)

    def _start(self, image: Array, counts: SampleCounts | None) -> ViewMemory:
        """Eq. 7: the first image is its own control variate."""
        empty = welford.init(image)
        relative = image * 0.0 + 1.0
        if counts is not None:
            relative = relative / counts.divisors
        return ViewMemory(image, relative, image * 0.0, empty, empty, empty)

    def _observe(self, memory: ViewMemory, F: Array, H: Array, number: Array | float) -> ViewMemory:
        return replace(
            memory,
            current=welford.update(memory.current, F, F, self.alpha, self.beta, number),
            previous=welford.update(memory.previous, H, H, self.alpha, self.beta, number),
            joint=welford.update(memory.joint, F, H, self.alpha, self.beta, number),
        )
