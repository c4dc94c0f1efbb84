"""Mini-batches of whole views."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from unrender.core import arrays, checks
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels.base import MiniBatch, check_batch
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem


@register
@dataclass(frozen=True)
class Views:
    """Draw some views per step, each set of `count` views with equal probability, and render all of their pixels. Unbiased.

    The fixed cost of a view falls with the number of views: borders of moving shapes, small pictures. Pixels drawn from all views at once
    (`Uniform`) leave it as it is. The variance of the gradient grows by the differences between views.

    Args:
        count: Views per step, >= 1; all views where the problem has no more.
    """

    count: int

    def __post_init__(self):
        checks.integer("Views", "count", self.count, at_least=1)

    def init(self, problem: Problem, parameters: Tree) -> None:
        """See `PixelSampler.init`: there is no state."""
        del parameters
        check_batch("Views", problem, 1)

    def draw(self, problem: Problem, parameters: Tree, state: None, key: Key) -> tuple[MiniBatch, None]:
        del parameters, state
        return self.redraw(problem, None, key), None

    def redraw(self, problem: Problem, state: None, key: Key) -> MiniBatch:
        del state
        total = len(problem.views)
        count, random = min(self.count, total), np.random.default_rng(key.uint32())
        chosen = np.sort(random.choice(total, count, replace=False))
        return _whole(problem, chosen, np.full(count, total / count))

    def observe(self, problem: Problem, state: None, gradient: Tree) -> None:
        """See `PixelSampler.observe`: there is nothing to remember."""
        del problem, state, gradient


def _whole(problem: Problem, chosen: np.ndarray, weights: np.ndarray) -> MiniBatch:
    """All pixels of the chosen views, with the views' weights."""
    known = problem.sizes
    sizes = [math.prod(known[view]) for view in chosen]
    like = problem.renderer.array(np.repeat(weights, sizes)[:, None].astype(np.float32))
    views = arrays.like_integers(np.repeat(chosen, sizes), like)
    pixels = arrays.like_integers(np.concatenate([np.arange(size) for size in sizes]), like)
    return MiniBatch(PixelSample(views, pixels, like))
