"""Recursive control variates: an image estimate that reuses the samples of earlier steps.

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
from unrender.core.checks import Count, Fraction
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimate, PairRequest, needs_whole_views, variance_of_mean
from unrender.rendering.renderer import Rendering, Space
from unrender.scene.batches import Frame, FullView, JoinedViews, PixelBatch, PixelSample
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler
from unrender.statistics import welford
from unrender.statistics.paired_losses import slices_of_images
from unrender.statistics.recursion import advance

_MOST_PIXELS = 64
"""Maximum ratio of all pixels to those of a mini-batch at which its samples update the snapshot, since the update takes time in
proportion to all pixels."""


@dataclass(frozen=True)
class ViewMemory:
    """Control variate of a view and its statistics; every array is (H, W, 3), or (N, 3) for the pixels of several views.

    Attributes:
        image: the control variate ⟨F_n⟩_CV.
        relative_variance: variance of `image` relative to that of one step's ⟨F_n⟩_n, by the recurrence (10); relative to that of one
            sample if pixels have different numbers of samples.
        variance: variance of `image` by the recurrence in absolute units; 0 before statistics exist.
        current, previous, joint: running statistics of ⟨F_n⟩_n, of ⟨F_{n-1}⟩_n, and of both, per step or per sample as for
            `relative_variance`.
        sizes: (height, width) of each of several views; () for one view.
    """

    image: Array
    relative_variance: Array
    variance: Array
    current: welford.State
    previous: welford.State
    joint: welford.State
    sizes: tuple[tuple[int, int], ...] = ()

    def of_views(self) -> tuple[ViewMemory, ...]:
        if not self.sizes:
            return (self,)
        parts = [part for name, part in vars(self).items() if name != "sizes"]
        cut = zip(slices_of_images(self.sizes), self.sizes, strict=True)
        return tuple(ViewMemory(*(_of_view(part, rows, size) for part in parts)) for rows, size in cut)


def _of_view(part: Any, rows: slice, size: tuple[int, int]) -> Any:
    """Return one view of an array (N, 3), or of the arrays of statistics."""
    if isinstance(part, welford.State):
        return welford.State(**{name: _of_view(x, rows, size) for name, x in vars(part).items()})
    return arrays.reshape(part[rows], (*size, 3)) if len(arrays.shape(part)) == 2 else part


@dataclass(frozen=True)
class Snapshot:
    """Control variate for pixel mini-batches: the concatenated pixels of all views, (P, 3) each.

    Attributes:
        image: the control variate.
        weight: w of each pixel, from the statistics at the time of the snapshot.
        relative_variance: relative variance of `image`; see `ViewMemory`.
    """

    image: Array
    weight: Array
    relative_variance: Array


@dataclass(frozen=True)
class RecursiveControlVariateState:
    """State between steps.

    Attributes:
        parameters: parameters of the last step of full views; None before the first.
        views: control variate and statistics of each view, or of several views each; empty before the first step.
        snapshot: control variate for pixel mini-batches; None without them.
        step: number of steps of full views. `PairRequest.step` must equal it.
    """

    parameters: Tree | None = None
    views: tuple[ViewMemory, ...] = ()
    snapshot: Snapshot | None = None
    step: int = 0

    def upsampled(self, upsampler: Upsampler) -> RecursiveControlVariateState:
        """Return the state with the previous parameters interpolated; images are unchanged."""
        return self if self.parameters is None else replace(self, parameters=upsampler.tree(self.parameters))

    def of_views(self) -> tuple[ViewMemory, ...]:
        return tuple(memory for joined in self.views for memory in joined.of_views())

    def of_single_views(self) -> RecursiveControlVariateState:
        """Return the equivalent state with a memory for each view."""
        return replace(self, views=self.of_views())

    def control_variates(self) -> tuple[Tree, tuple[Array, ...]] | None:
        """Return the parameters of the control variates, and the control variate of each view; None before the first step."""
        return None if self.parameters is None else (self.parameters, tuple(memory.image for memory in self.of_views()))


@register
@dataclass(frozen=True)
class RecursiveControlVariate:
    """Control variate of the previous step's image: ⟨F_n⟩_CV = ⟨F_n⟩_n + w_n (⟨F_{n-1}⟩_CV − ⟨F_{n-1}⟩_n) (Eq. 6).

    The recursion applies per view, pixel and colour channel. The weight (Eq. 8) uses statistics of earlier steps only, which are updated
    after use. A small bias remains (section 3.2 of the paper), because the weight depends on the samples in ⟨F_{n-1}⟩_CV. Consistent: for
    constant parameters the image converges to the exact one.

    Args:
        space: "path" shares paths between the two states: one trace for materials and emitters, two traces for meshes that move.
            "primary" shares random numbers: two traces, any parameter, less correlation.
        alpha: decay of the running means, in [0, 1).
        beta: decay of the running (co)variances, in [0, 1).
        whole_views: number of steps with pixel mini-batches between two steps of full views, >= 1.
        learn_from_draws: whether samples of mini-batches also update the control variate.
        max_weight: upper bound of the weights, in (0, 1]; 1 in the paper. With a smaller bound, an error of the image is forgotten after
            about 1 / (1 - max_weight) steps. With 1, an error lasts as long as the run so far, and the optimizer follows it as if it were
            signal. If rare bright paths dominate the noise, the parameters then become worse again.

    With pixel mini-batches the control variate is a snapshot, because pixels outside the batch are not updated. A step s of full views,
    at full cost, updates image and statistics. Until the next such step, each mini-batch uses ⟨F_n⟩ + w (⟨F_s⟩_CV − ⟨F_s⟩_n). The
    mini-batch's samples of state s are independent of ⟨F_s⟩_CV, so after use both are averaged with weights from their variances
    (`learn_from_draws`). This is skipped if a mini-batch has less than a 64th of all pixels, or if views are distributed to workers.

    The state restarts when a parameter changes its shape.

    Var[⟨F_n⟩_CV] is the larger of two recurrences (10). One is relative to Var[⟨F_n⟩_n], to which (10) is invariant. An absolute variance
    alone would freeze the first, worst estimate: a pixel whose first samples happen to agree would have variance 0 and weight 1, and keep
    its first value. The other recurrence is absolute, because a relative variance follows Var[⟨F_n⟩_n] when parameters move, whereas the
    error of the image does not. Where both states have always agreed, as in pixels independent of the unknowns, the relative recurrence
    alone is exact, and images are averaged.

    Where the sample variance is still zero, in the first steps or in a pixel that has always been black, the two states count as fully
    correlated. The weight is 1 / (1 + r) for the relative variance r, which becomes r / (1 + r), so images are averaged. A weight of 0
    would discard the black samples at the first bright one and make the pixel too bright.
    """

    space: Space = "path"
    alpha: Fraction = 0.9
    beta: Fraction = 0.999
    whole_views: Count = 20
    learn_from_draws: bool = True
    max_weight: float = 1.0
    pixelwise = True  # with a snapshot as control variate

    def __post_init__(self):
        checks.fields(self)
        if not checks.number("RecursiveControlVariate", "max_weight", self.max_weight, above=0.0) <= 1:
            raise InputError(f"RecursiveControlVariate: max_weight must be in (0, 1], got {self.max_weight!r}")

    def init(self, problem: Problem, parameters: Tree) -> RecursiveControlVariateState:
        return RecursiveControlVariateState()

    needs_whole_views = needs_whole_views

    def needs_full_views(self, parameters: Tree, state: RecursiveControlVariateState, batches: int) -> bool:
        """Return True at the first step, after a change of shapes, and after `whole_views` mini-batches."""
        return batches >= self.whole_views or self._is_first(parameters, state)

    def prepare(self, problem: Problem, state: RecursiveControlVariateState) -> RecursiveControlVariateState:
        parts = [(memory.image, self._weight(memory), memory.relative_variance) for memory in state.views]
        return replace(
            state, snapshot=Snapshot(*(arrays.concatenate([arrays.rows(part[n]) for part in parts]) for n in range(3)))
        )

    def learn(
        self, problem: Problem, state: RecursiveControlVariateState, sample: PixelSample, contribution: Array | None
    ) -> RecursiveControlVariateState:
        """Average the snapshot with the mini-batch's renderings of the snapshot's state.

        Consider a pixel with relative variance r that was sampled k times, with mean H. Its image becomes the mean of least variance,
        image + r k / (1 + r k) (H - image), and r becomes r' = r / (1 + r k). Its weight is multiplied by (1 + r) / (1 + r').
        """
        snapshot = state.snapshot
        if not self.learn_from_draws or contribution is None or snapshot is None:
            return state
        count = int(arrays.shape(snapshot.image)[0])
        if count > _MOST_PIXELS * int(arrays.shape(contribution)[0]):
            return state
        row = arrays.numpy(problem.references.rows(sample.views, sample.pixels)).astype(np.int64)
        order = np.argsort(row, kind="stable")
        distinct, starts, numbers = np.unique(row[order], return_index=True, return_counts=True)
        sums = arrays.segment_sums(
            arrays.gather_rows(contribution, arrays.like_integers(order, contribution)),
            arrays.like_integers(starts, contribution),
            arrays.like_integers(numbers, contribution),
        )
        times = arrays.like(np.repeat(numbers[:, None], 3, axis=1).astype(np.float32), contribution)
        where = arrays.like_integers(distinct, contribution)
        total, number = (arrays.add_rows(x, where, count) for x in (sums, times))
        past = snapshot.relative_variance
        after = past / (1.0 + past * number)
        image = snapshot.image + after * (total - number * snapshot.image)
        weight = arrays.minimum(snapshot.weight * (1.0 + past) / (1.0 + after), self.max_weight)
        return replace(state, snapshot=Snapshot(image, weight, after))

    def _with_mini_batches(self, state: RecursiveControlVariateState, view: int) -> ViewMemory:
        """Return a view's control variate, updated by the mini-batches since its last step."""
        memory, snapshot = state.views[view], state.snapshot
        if snapshot is None or not self.learn_from_draws:
            return memory
        sizes = [arrays.shape(other.image) for other in state.views]
        first = sum(math.prod(size[:-1]) for size in sizes[:view])
        rows = slice(first, first + math.prod(sizes[view][:-1]))
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
        """Estimate the image of one frame. The image of group g uses F and H from the samples of group g only.

        The previous state is always rendered, in this estimator's space. Its image H + w (⟨F_{n-1}⟩_CV − H) shares the error of the
        current one; the two differ by F − H. If the control variate is a snapshot of an earlier step s, but the pair is requested of a
        later step, that step is rendered with the same random numbers, too. Its image is P + w (⟨F_s⟩_CV − H) for the rendering P.

        Raises:
            InputError: the requested pair belongs to another step than the control variate, or a mini-batch precedes the first full views.
        """
        first = self._is_first(parameters, state)
        if pair_request is not None and pair_request.step != state.step:
            raise InputError(
                f"RecursiveControlVariate: its state is of step {state.step}, the requested pair of step {pair_request.step}"
            )
        previous = parameters if first or state.parameters is None else state.parameters
        request = replace(frame.request(spp, key.uint32(), groups), both_gradients=pair_request is not None)
        session = problem.renderer.prepare(list(parameters), self.space)
        rendering = session.image_pair(parameters, previous, request, self.space)
        requested = rendering
        if pair_request is not None and pair_request.batches:
            requested = session.image_pair(parameters, pair_request.previous, request, self.space)
        match frame:
            case FullView() | JoinedViews():
                if first:
                    images, previous_images, counts = rendering.images, rendering.previous, frame.counts
                    variance = variance_of_mean(images, counts)
                    estimate = ImageEstimate(images, rendering.paths, {}, previous_images, variance, counts=counts)
                    return estimate, self._start(estimate.mean(), frame)
                return self._combine_view(self._with_mini_batches(state, frame.memory), rendering, requested, frame)
            case PixelBatch():
                if first or state.snapshot is None:
                    raise InputError("RecursiveControlVariate: a pixel mini-batch needs an earlier step of full views")
                contribution = arrays.mean_over_first(rendering.previous)
                return self._combine_pixels(problem, state.snapshot, frame, rendering, requested), contribution
        raise InputError(f"RecursiveControlVariate: expected a full view or a pixel mini-batch, got {frame!r}")

    @staticmethod
    def _combine_pixels(
        problem: Problem, snapshot: Snapshot, frame: PixelBatch, rendering: Rendering, requested: Rendering
    ) -> ImageEstimate:
        """Return both images of a mini-batch, (groups, N, 3), with the snapshot as control variate; `requested` renders the previous
        one."""
        row = problem.references.rows(frame.sample.views, frame.sample.pixels)
        image, weight, past = (
            arrays.gather_rows(x, row) for x in (snapshot.image, snapshot.weight, snapshot.relative_variance)
        )
        current = advance(image, rendering.images, rendering.previous, weight)
        previous = advance(image, requested.previous, rendering.previous, weight)
        variance = variance_of_mean(current)
        if variance is not None:
            variance = variance + weight * weight * past * variance_of_mean(rendering.previous)
        return ImageEstimate(current, requested.paths, previous=previous, variance=variance)

    def _combine_view(
        self, memory: ViewMemory, rendering: Rendering, requested: Rendering, frame: FullView | JoinedViews
    ) -> tuple[ImageEstimate, ViewMemory]:
        """Return both images of a view, (groups, H, W, 3) or samples (1, N, 3), and the next memory; `requested` renders the previous
        one."""
        counts = frame.counts
        number: Array | float = 1.0 if counts is None else counts.divisors
        mean = arrays.mean_over_first if counts is None else counts.means
        F, H = mean(rendering.images), mean(rendering.previous)
        past, weight = memory.relative_variance, self._weight(memory, number)
        image, weights = frame.expand(memory.image), frame.expand(weight)
        current = advance(image, rendering.images, rendering.previous, weights)
        observed = self._observe(memory, F, H, number)
        var_current, var_previous = welford.covariance(observed.current), welford.covariance(observed.previous)
        cov = welford.covariance(observed.joint)
        variance = statistics.control_variate_variance(
            weight, var_current / number, var_previous / number, cov / number, past * var_previous
        )
        known = var_current > 0
        averaged = weight * weight * past + (1.0 - weight) * (1.0 - weight) / number
        relative = arrays.where(known, variance / arrays.where(known, var_current, 1.0), averaged)
        has_absolute = memory.variance > 0
        absolute = statistics.control_variate_variance(
            weight,
            var_current / number,
            var_previous / number,
            cov / number,
            arrays.where(has_absolute, memory.variance, past * var_previous),
        )
        differ = ((cov != var_previous) | (cov != var_current)) & (var_previous > 0)
        variance = relative * var_current
        variance = arrays.where(differ, arrays.maximum(variance, absolute), variance)
        of_absolute = absolute / arrays.where(differ, var_previous, 1.0)
        relative = arrays.where(differ, arrays.maximum(relative, of_absolute), relative)
        info = {"control_weight": weight, "variance": variance}
        previous = advance(image, requested.previous, rendering.previous, weights)
        if (within := variance_of_mean(rendering.images, counts)) is not None:
            variance = arrays.where(known, variance, relative * number * within)
        estimate = ImageEstimate(
            current, requested.paths, info, previous, variance, fresh=rendering.images, counts=counts
        )
        return estimate, replace(observed, image=estimate.mean(), relative_variance=relative, variance=absolute)

    def advance(
        self, parameters: Tree, state: RecursiveControlVariateState, contributions: tuple[Any, ...]
    ) -> RecursiveControlVariateState:
        return RecursiveControlVariateState(parameters, contributions, step=state.step + 1)

    def _is_first(self, parameters: Tree, state: RecursiveControlVariateState) -> bool:
        return state.parameters is None or trees.shapes(state.parameters) != trees.shapes(parameters)

    def _weight(self, memory: ViewMemory, number: Array | float = 1.0) -> Array:
        """Return the control weight of a step with `number` samples of those that the statistics describe."""
        var_previous, past = welford.covariance(memory.previous), memory.relative_variance * number
        best = arrays.where(
            var_previous > 0,
            statistics.control_weight(welford.covariance(memory.joint), var_previous, past * var_previous),
            1.0 / (1.0 + past),
        )
        return arrays.minimum(best, self.max_weight)

    def _start(self, image: Array, frame: FullView | JoinedViews) -> ViewMemory:
        """Return the memory after the first step, whose image is its own control variate (Eq. 7)."""
        empty = welford.init(image)
        relative = image * 0.0 + 1.0
        if frame.counts is not None:
            relative = relative / frame.counts.divisors
        sizes = tuple(size for _, size in frame.complete_views) if isinstance(frame, JoinedViews) else ()
        return ViewMemory(image, relative, image * 0.0, empty, empty, empty, sizes)

    def _observe(self, memory: ViewMemory, F: Array, H: Array, number: Array | float) -> ViewMemory:
        return replace(
            memory,
            current=welford.update(memory.current, F, F, self.alpha, self.beta, number),
            previous=welford.update(memory.previous, H, H, self.alpha, self.beta, number),
            joint=welford.update(memory.joint, F, H, self.alpha, self.beta, number),
        )
