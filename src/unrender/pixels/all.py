"""Sampler of all pixels of all views."""

from __future__ import annotations

from dataclasses import dataclass

from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels.base import MiniBatch, PixelSampler
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Unchanged


@dataclass(frozen=True)
class AllState(Unchanged):
    """Empty state."""


@register
@dataclass(frozen=True)
class All(PixelSampler):
    """All pixels of all views at every step."""

    def init(self, problem: Problem, parameters: Tree) -> AllState:
        del problem, parameters
        return AllState()

    def draw(self, problem: Problem, parameters: Tree, state: AllState, key: Key) -> tuple[MiniBatch, AllState]:
        del problem, parameters, key
        return MiniBatch(None), state

    def redraw(self, problem: Problem, state: AllState, key: Key) -> MiniBatch:
        del problem, state, key
        return MiniBatch(None)
