"""Pixels drawn with equal probabilities: plain mini-batches."""

from __future__ import annotations

from dataclasses import dataclass

from unrender import checks
from unrender.keys import Key
from unrender.pixels.base import Pick, check_loss
from unrender.pixels.cells import Table, cut
from unrender.problem.problem import Problem
from unrender.trees import Tree


@dataclass(frozen=True)
class UniformState:
    """State between steps: the table of draws, which stays as it is."""

    table: Table


@dataclass(frozen=True)
class Uniform:
    """Every pixel of every view is equally likely.

    Args:
        count: pixels a step, >= 1, drawn with replacement.
        stratified: spread the draws evenly over the views (`cells.Table.draw`); otherwise they are independent.
    """

    count: int
    stratified: bool = True

    def __post_init__(self):
        checks.whole("Uniform", "count", self.count, at_least=1)

    def init(self, problem: Problem, parameters: Tree) -> UniformState:
        """See `PixelSampler.init`."""
        del parameters
        check_loss(problem)
        cells = cut(problem, 2 * self.count)
        return UniformState(Table.of(cells, cells.sizes, problem.renderer.array))

    def draw(self, problem: Problem, parameters: Tree, state: UniformState, key: Key) -> tuple[Pick, UniformState]:
        """See `PixelSampler.draw`."""
        del problem, parameters
        return Pick(state.table.draw(self.count, key, self.stratified)), state

    def observe(self, problem: Problem, state: UniformState, gradient: Tree) -> UniformState:
        """Nothing to learn from."""
        del problem, gradient
        return state
