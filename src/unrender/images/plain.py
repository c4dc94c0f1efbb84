"""Plain Monte Carlo image estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimate, PairRequest, WithoutSnapshot, variance_of_mean
from unrender.scene.batches import Frame, FullView
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Unchanged


@dataclass(frozen=True)
class PlainState(Unchanged):
    """Empty state."""


@register
@dataclass(frozen=True)
class Plain(WithoutSnapshot):
    """One independent rendering per step. Unbiased."""

    space, pixelwise = None, True

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

    def needs_full_views(self, parameters: Tree, state: PlainState, batches: int) -> bool:
        """Return False."""
        del parameters, state, batches
        return False

    def advance(self, parameters: Tree, state: PlainState, contributions: tuple[Any, ...]) -> PlainState:
        del parameters, contributions
        return state
