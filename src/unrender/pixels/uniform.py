"""Pixel mini-batches with equal probabilities."""

from __future__ import annotations

from dataclasses import dataclass

from unrender.core import checks
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels.base import MiniBatch, check_batch
from unrender.pixels.tiles import InverseCdfTable, cut
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Upsampler


@dataclass(frozen=True)
class UniformState:
    """State between steps: the constant table that pixels are sampled from."""

    table: InverseCdfTable

    def upsampled(self, upsampler: Upsampler) -> UniformState:
        """Return this state, which has no array of a parameter's shape."""
        del upsampler
        return self


@register
@dataclass(frozen=True)
class Uniform:
    """Uniform sampling of the pixels of all views. Unbiased.

    Args:
        count: pixels per step, >= 1, sampled with replacement.
        stratified: whether samples are stratified over all pixels (`tiles.InverseCdfTable.draw`); independent otherwise.
    """

    count: int
    stratified: bool = True

    def __post_init__(self):
        checks.flags(self)
        checks.integer("Uniform", "count", self.count, at_least=1)

    def init(self, problem: Problem, parameters: Tree) -> UniformState:
        del parameters
        check_batch("Uniform", problem, self.count)
        tiles = cut(problem, 2 * self.count)
        return UniformState(InverseCdfTable.of(tiles, tiles.sizes, problem.renderer.array))

    def draw(self, problem: Problem, parameters: Tree, state: UniformState, key: Key) -> tuple[MiniBatch, UniformState]:
        del parameters
        return self.redraw(problem, state, key), state

    def redraw(self, problem: Problem, state: UniformState, key: Key) -> MiniBatch:
        del problem
        return MiniBatch(state.table.draw(self.count, key, self.stratified))

    def observe(self, problem: Problem, state: UniformState, gradient: Tree) -> UniformState:
        """Return the state unchanged."""
        del problem, gradient
        return state
