"""All pixels of all views, and mini-batches in which all pixels, or all views, are equally likely."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unrender.core import arrays, checks
from unrender.core.checks import Count
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels.base import MiniBatch, PixelSampler, check_batch
from unrender.pixels.tiles import InverseCdfTable, cut
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem
from unrender.scene.upsampling import Unchanged


@dataclass(frozen=True)
class UniformState(Unchanged):
    """State between steps: the constant table that pixels are sampled from."""

    table: InverseCdfTable


@register
@dataclass(frozen=True)
class Uniform(checks.Checked, PixelSampler):
    """Uniform sampling of the pixels of all views. Unbiased.

    Args:
        count: pixels per step, >= 1, sampled with replacement.
        stratified: whether samples are stratified over all pixels (`tiles.InverseCdfTable.draw`); independent otherwise.
    """

    count: Count
    stratified: bool = True

    def init(self, problem: Problem, parameters: Tree) -> UniformState:
        check_batch("Uniform", problem, self.count)
        tiles = cut(problem, 2 * self.count)
        return UniformState(InverseCdfTable.of(tiles, tiles.sizes, problem.renderer.array))

    def draw(self, problem: Problem, parameters: Tree, state: UniformState, key: Key) -> tuple[MiniBatch, UniformState]:
        return self.redraw(problem, state, key), state

    def redraw(self, problem: Problem, state: UniformState, key: Key) -> MiniBatch:
        return MiniBatch(state.table.draw(self.count, key, self.stratified))


@register
@dataclass(frozen=True)
class Views(checks.Checked, PixelSampler):
    """Mini-batch of full views: each set of `count` views is equally likely, and all its pixels are rendered. Unbiased.

    It reduces costs that grow with the number of views, which mini-batches of pixels (`Uniform`) do not: boundary gradients of moving
    shapes, and launches of small images. The differences between views add to the variance of the gradient.

    Args:
        count: views per step, >= 1; all views if the problem has no more.
    """

    count: Count

    def init(self, problem: Problem, parameters: Tree) -> None:
        """Return None, as there is no state. Raises `InputError` for a loss that is not pixelwise."""
        check_batch("Views", problem, 1)

    def draw(self, problem: Problem, parameters: Tree, state: None, key: Key) -> tuple[MiniBatch, None]:
        return self.redraw(problem, None, key), None

    def redraw(self, problem: Problem, state: None, key: Key) -> MiniBatch:
        total = len(problem.views)
        count, random = min(self.count, total), np.random.default_rng(key.uint32())
        chosen = np.sort(random.choice(total, count, replace=False))
        return _all_pixels(problem, chosen, np.full(count, total / count))


def _all_pixels(problem: Problem, chosen: np.ndarray, weights: np.ndarray) -> MiniBatch:
    known = problem.sizes
    sizes = [math.prod(known[view]) for view in chosen]
    like = problem.renderer.array(np.repeat(weights, sizes)[:, None].astype(np.float32))
    views = arrays.like_integers(np.repeat(chosen, sizes), like)
    pixels = arrays.like_integers(np.concatenate([np.arange(size) for size in sizes]), like)
    return MiniBatch(PixelSample(views, pixels, like))


@dataclass(frozen=True)
class AllState(Unchanged):
    """Empty state."""


@register
@dataclass(frozen=True)
class All(PixelSampler):
    """All pixels of all views at every step."""

    def init(self, problem: Problem, parameters: Tree) -> AllState:
        return AllState()

    def draw(self, problem: Problem, parameters: Tree, state: AllState, key: Key) -> tuple[MiniBatch, AllState]:
        return MiniBatch(None), state

    def redraw(self, problem: Problem, state: AllState, key: Key) -> MiniBatch:
        return MiniBatch(None)
