"""Every pixel of every view, every step."""

from __future__ import annotations

from dataclasses import dataclass

from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels.base import MiniBatch
from unrender.problem.problem import Problem
from unrender.problem.upsampling import Upsampler


@dataclass(frozen=True)
class AllState:
    """Nothing is kept."""

    def upsampled(self, upsampler: Upsampler) -> AllState:
        """See `Upsamplable`: nothing in it has a parameter's shape."""
        del upsampler
        return self


@register
@dataclass(frozen=True)
class All:
    """Look at the whole film of each view at each step."""

    def init(self, problem: Problem, parameters: Tree) -> AllState:
        """See `PixelSampler.init`."""
        del problem, parameters
        return AllState()

    def draw(self, problem: Problem, parameters: Tree, state: AllState, key: Key) -> tuple[MiniBatch, AllState]:
        """See `PixelSampler.draw`."""
        del problem, parameters, key
        return MiniBatch(None), state

    def observe(self, problem: Problem, state: AllState, gradient: Tree) -> AllState:
        """Nothing to learn from."""
        del problem, gradient
        return state
