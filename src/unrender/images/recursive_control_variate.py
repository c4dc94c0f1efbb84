"""Recursive control variates: an image that keeps what earlier steps rendered.

Nicolet et al. 2023, "Recursive Control Variates for Inverse Rendering".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from unrender import statistics
from unrender.core import arrays, checks, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimate, PairRequest
from unrender.problem.batches import Frame, PixelBatch, WholeView
from unrender.problem.problem import Problem
from unrender.problem.upsampling import Upsampler
from unrender.rendering.renderer import Space
from unrender.statistics import welford
from unrender.statistics.recursion import advance


@dataclass(frozen=True)
class ViewMemory:
    """What is kept of one view; every array (H, W, 3).

    Attributes:
        image: the control variate ⟨F_n⟩_CV.
        relative_variance: of `image`, in units of one step's ⟨F_n⟩_n, by the recurrence (10).
        current, previous, joint: running statistics of ⟨F_n⟩_n, of ⟨F_{n-1}⟩_n, and of both.
    """

    image: Array
    relative_variance: Array
    current: welford.State
    previous: welford.State
    joint: welford.State


@dataclass(frozen=True)
class Snapshot:
    """What steps of drawn pixels look up: all views' pixels one behind the other, (P, 3) each.

    Attributes:
        image: the control variate.
        weight: that a new sample gives it.
    """

    image: Array
    weight: Array


@dataclass(frozen=True)
class RecursiveControlVariateState:
    """State between steps.

    Attributes:
        parameters: of the last step that looked at whole views; None before the first.
        views: what is kept of each view; empty before the first step.
        snapshot: the same for drawn pixels; None where none are drawn.
    """

    parameters: Tree | None = None
    views: tuple[ViewMemory, ...] = ()
    snapshot: Snapshot | None = None

    def upsampled(self, upsampler: Upsampler) -> RecursiveControlVariateState:
        """See `Upsamplable`: the previous parameters are interpolated, images stay."""
        return self if self.parameters is None else replace(self, parameters=upsampler.tree(self.parameters))


@register
@dataclass(frozen=True)
class RecursiveControlVariate:
    """⟨F_n⟩_CV = ⟨F_n⟩_n + w_n (⟨F_{n-1}⟩_CV − ⟨F_{n-1}⟩_n), Eq. 6, per view, pixel and colour channel.

    The weight (Eq. 8) comes from statistics of earlier steps only: they are updated after use, which leaves the small bias
    that section 3.2 of the paper describes (the weight still knows the samples inside ⟨F_{n-1}⟩_CV). Consistent: with
    unchanging parameters the image converges to the exact one.

    Args:
        space: "path" shares paths between the two states (one trace; materials and emitters); "primary" shares random
            numbers (two traces; any parameter, less correlation).
        alpha: decay of the running means, in [0, 1).
        beta: decay of the running (co)variances, in [0, 1).
        whole_views: with drawn pixels, a step of whole views comes after that many steps of drawn ones, >= 1.
        update_before_use: the biased order of Fig. 4, left: the weight sees the samples that it weighs. For comparison only.

    With drawn pixels the control variate is a snapshot, since a pixel that is not drawn is not carried along: a step of whole views
    brings image and statistics to its parameters, and until the next one the drawn pixels take ⟨F_n⟩ + w (⟨F_s⟩_CV − ⟨F_s⟩_n) against
    that step s. Whole steps cost what they do: few for large pictures.

    The state starts anew when a parameter changes its shape.

    Var[⟨F_n⟩_CV] is kept relative to Var[⟨F_n⟩_n], which the recurrence (10) leaves as it is. Kept absolute, it would
    freeze the first, worst estimate of the variance: a pixel whose first samples happen to agree would get variance 0, weight
    1, and its first value for ever.

    Where no variance was seen yet, at the first steps or in a pixel that has only been black, the two states count as fully correlated:
    the weight is 1 / (1 + r) for the relative variance r, which becomes r / (1 + r), so that images are averaged. A weight of 0 would
    drop the black samples as soon as a bright one comes, and leave the pixel too bright.
    """

    space: Space = "path"
    alpha: float = 0.9
    beta: float = 0.999
    update_before_use: bool = False
    whole_views: int = 20

    def __post_init__(self):
        checks.integer("RecursiveControlVariate", "whole_views", self.whole_views, at_least=1)
        if self.space not in ("path", "primary"):
            raise InputError(f'RecursiveControlVariate: space must be "path" or "primary", got {self.space!r}')
        for name in ("alpha", "beta"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"RecursiveControlVariate: {name} must be in [0, 1), got {getattr(self, name)!r}")

    def init(self, problem: Problem, parameters: Tree) -> RecursiveControlVariateState:
        """See `ImageEstimator.init`."""
        del problem, parameters
        return RecursiveControlVariateState()

    @property
    def pixelwise(self) -> bool:
        """True: from a snapshot."""
        return True

    def needs_whole_views(self, parameters: Tree, state: RecursiveControlVariateState, batches: int) -> bool:
        """At first, when shapes change, and every so often."""
        return batches >= self.whole_views or self._fresh(parameters, state)

    def prepare(self, problem: Problem, state: RecursiveControlVariateState) -> RecursiveControlVariateState:
        """See `ImageEstimator.prepare`."""
        del problem
        parts = [(memory.image, self._weight(memory)) for memory in state.views]
        image, weight = (arrays.concatenated([arrays.rows(part[n]) for part in parts]) for n in range(2))
        return replace(state, snapshot=Snapshot(image, weight))

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
    ) -> tuple[ImageEstimate, ViewMemory | None]:
        """See `ImageEstimator.estimate`. Group g's image takes F and H from group g's samples alone.

        The previous state is always rendered, in the own space; its image H + w (⟨F_{n-1}⟩_CV − H) has the error of the current
        one as far as the two can share it: they differ by F − H.
        """
        request = frame.request(spp, key.uint32(), groups)
        fresh = self._fresh(parameters, state)
        previous = parameters if fresh or state.parameters is None else state.parameters
        # Two memories that are carried together must be of the same step.
        assert pair_request is None or all(previous[key] is value for key, value in pair_request.previous.items())
        rendering = problem.renderer.image_pair(parameters, previous, request, self.space)
        assert rendering.previous is not None
        if isinstance(frame, PixelBatch):
            assert state.snapshot is not None
            assert not fresh
            row = problem.references.rows(frame.draw.views, frame.draw.pixels)
            image, weight = (arrays.gather_rows(x, row) for x in (state.snapshot.image, state.snapshot.weight))
            images = advance(image, rendering.images, rendering.previous, weight)
            beside_it = advance(image, rendering.previous, rendering.previous, weight)
            return ImageEstimate(images, rendering.paths, previous=beside_it), None
        assert isinstance(frame, WholeView)
        if fresh:
            estimate = ImageEstimate(rendering.images, rendering.paths, previous=rendering.previous)
            return estimate, self._start(estimate.mean())
        memory = state.views[frame.view]
        F, H = arrays.mean_first(rendering.images), arrays.mean_first(rendering.previous)
        used = self._observe(memory, F, H) if self.update_before_use else memory
        past, weight = memory.relative_variance, self._weight(used)
        images = advance(memory.image, rendering.images, rendering.previous, weight)
        seen = used if self.update_before_use else self._observe(memory, F, H)
        var_current, var_previous = welford.covariance(seen.current), welford.covariance(seen.previous)
        variance = statistics.control_variate_variance(
            weight,
            var_current,
            var_previous,
            welford.covariance(seen.joint),
            past * var_previous,
        )
        known = var_current > 0
        relative = arrays.where(known, variance / arrays.where(known, var_current, 1.0), past / (1.0 + past))
        info = {"control_weight": weight, "variance": variance}
        beside_it = advance(memory.image, rendering.previous, rendering.previous, weight)
        estimate = ImageEstimate(images, rendering.paths, info, beside_it)
        return estimate, replace(seen, image=estimate.mean(), relative_variance=relative)

    def advance(
        self, parameters: Tree, state: RecursiveControlVariateState, kept: tuple[Any, ...]
    ) -> RecursiveControlVariateState:
        """See `ImageEstimator.advance`."""
        del state
        return RecursiveControlVariateState(parameters, kept)

    def _fresh(self, parameters: Tree, state: RecursiveControlVariateState) -> bool:
        return state.parameters is None or trees.shapes(state.parameters) != trees.shapes(parameters)

    def _weight(self, memory: ViewMemory) -> Array:
        var_previous, past = welford.covariance(memory.previous), memory.relative_variance
        return arrays.where(
            var_previous > 0,
            statistics.control_weight(welford.covariance(memory.joint), var_previous, past * var_previous),
            1.0 / (1.0 + past),
        )

    def _start(self, image: Array) -> ViewMemory:
        """Eq. 7: the first image is its own control variate."""
        empty = welford.init(image)
        return ViewMemory(image, image * 0.0 + 1.0, empty, empty, empty)

    def _observe(self, memory: ViewMemory, F: Array, H: Array) -> ViewMemory:
        return replace(
            memory,
            current=welford.update(memory.current, F, F, self.alpha, self.beta),
            previous=welford.update(memory.previous, H, H, self.alpha, self.beta),
            joint=welford.update(memory.joint, F, H, self.alpha, self.beta),
        )
