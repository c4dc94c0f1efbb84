"""Plain Monte Carlo image estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimate, PairRequest, needs_whole_views, variance_of_mean
from unrender.rendering.renderer import Space
from unrender.scene.batches import Frame, FullView, PixelSample
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler


@dataclass(frozen=True)
class PlainState:
    """Empty state."""

    def upsampled(self, upsampler: Upsampler) -> PlainState:
        """Return this state, which has no array of a parameter's shape."""
        del upsampler
        return self


@register
@dataclass(frozen=True)
class Plain:
    """One independent rendering per step. Unbiased."""

    @property
    def space(self) -> Space | None:
        """None, because steps share no samples."""
        return None

    @property
    def pixelwise(self) -> bool:
        """True."""
        return True

    def init(self, problem: Problem, parameters: Tree) -> PlainState:
        del problem, parameters
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
        del state
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

    needs_whole_views = needs_whole_views

    def needs_full_views(self, parameters: Tree, state: PlainState, batches: int) -> bool:
        """Return False."""
        del parameters, state, batches
        return False

    def prepare(self, problem: Problem, state: PlainState) -> PlainState:
        del problem
        return state

    def learn(self, problem: Problem, state: PlainState, sample: PixelSample, contribution: Any) -> PlainState:
        del problem, sample, contribution
        return state

    def advance(self, parameters: Tree, state: PlainState, contributions: tuple[Any, ...]) -> PlainState:
        del parameters, contributions
        return state
