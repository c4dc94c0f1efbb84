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
from unrender.problem.batches import PixelSample
from unrender.problem.problem import Problem

__all__ = ["Views"]


@register
@dataclass(frozen=True)
class Views:
    """All pixels of some views, others at each step: any set of `count` views is equally likely. Unbiased.

    What a step costs for each view that it looks at, whatever the number of its pixels (borders of moving shapes, small pictures), falls
    with the number of views; pixels drawn from all views at once (`Uniform`) leave it as it is. The gradient varies with the views.

    Args:
        count: views a step, >= 1; where the problem has no more, all.
    """

    count: int

    def __post_init__(self):
        checks.integer("Views", "count", self.count, at_least=1)

    def init(self, problem: Problem, parameters: Tree) -> None:
        """See `PixelSampler.init`: there is no state."""
        del parameters
        check_batch("Views", problem, 1)

    def draw(self, problem: Problem, parameters: Tree, state: None, key: Key) -> tuple[MiniBatch, None]:
        """See `PixelSampler.draw`."""
        del parameters, state
        return self.redraw(problem, None, key), None

    def redraw(self, problem: Problem, state: None, key: Key) -> MiniBatch:
        """See `RepeatableSampler.redraw`."""
        del state
        total = len(problem.views)
        count = min(self.count, total)
        chosen = np.sort(np.random.default_rng(key.uint32()).choice(total, count, replace=False))
        sizes = [math.prod(problem.sizes[view]) for view in chosen]
        like = problem.renderer.array(np.full((sum(sizes), 1), total / count, np.float32))
        views = arrays.like_integers(np.repeat(chosen, sizes), like)
        pixels = arrays.like_integers(np.concatenate([np.arange(size) for size in sizes]), like)
        return MiniBatch(PixelSample(views, pixels, like))

    def observe(self, problem: Problem, state: None, gradient: Tree) -> None:
        """Unchanged: the gradient is not used."""
        del problem, state, gradient
