"""Every pixel of every view, every step."""

from __future__ import annotations

from dataclasses import dataclass

from unrender.keys import Key
from unrender.pixels.base import Pick
from unrender.problem.problem import Problem
from unrender.trees import Tree


@dataclass(frozen=True)
class AllState:
    """Nothing is kept."""


@dataclass(frozen=True)
class All:
    """Look at the whole film of each view at each step."""

    def init(self, problem: Problem, parameters: Tree) -> AllState:
        """See `PixelSampler.init`."""
        del problem, parameters
        return AllState()

    def draw(self, problem: Problem, parameters: Tree, state: AllState, key: Key) -> tuple[Pick, AllState]:
        """See `PixelSampler.draw`."""
        del problem, parameters, key
        return Pick(None), state

    def observe(self, problem: Problem, state: AllState, gradient: Tree) -> AllState:
        """Nothing to learn from."""
        del problem, gradient
        return state
