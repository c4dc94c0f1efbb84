"""How much of the gradient is noise: as its estimator says, or seen from the stream of gradients alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

from unrender.core import arrays, memory, trees
from unrender.core.arrays import Array
from unrender.core.trees import Tree

_DECAY = 0.9
_EVERY = 7
"""Of large arrays, whose mean gradient would take as much memory as they do, one element in so many is looked at."""


@dataclass
class GradientNoise:
    """The share of the gradient's second moment E‖g‖² that is noise, from exponentially weighted means over about ten steps.

    With decay a, the mean's squared norm is ‖ḡ‖² + ρ N for total variance N, ρ = (1 - a) / (1 + a), so N follows from it and from
    the second moment ‖ḡ‖² + N. A gradient that truly changes within ten steps counts as noise: a diagnostic, not an estimate. Of arrays
    of a million elements and more, every seventh is looked at.
    """

    mean: Tree | None = None
    second_moment: float = 0.0
    weight: float = 0.0

    def update(self, gradient: Tree, variance: Tree | None = None) -> float | None:
        """Add one gradient. Returns the share in [0, 1]; None until there are ten of them, unless the variance is given.

        With the variance that an estimator gives, it is the variance's share of ‖g‖², at once: gradients of an estimator that reuses
        earlier samples resemble one another, and would look free of noise.
        """
        if variance is not None:
            sums = sum(arrays.total(x) for x in variance.values()), _square(gradient)
            arrays.evaluate(sums)
            noise, square = (arrays.number(x) for x in sums)
            return min(noise / square, 1.0) if square > 0 else None
        seen = trees.map(lambda g: memory.every(g, _EVERY) if memory.is_large(g) else g, gradient)
        if self.mean is None or trees.shapes(self.mean) != trees.shapes(seen):
            self.mean, self.second_moment, self.weight = trees.zeros_like(seen), 0.0, 0.0
        self.mean = trees.map(lambda m, g: m * _DECAY + g * (1 - _DECAY), self.mean, seen)
        arrays.evaluate(self.mean, seen)
        shares = [
            math.prod(arrays.shape(g)) / math.prod(arrays.shape(x))
            for g, x in zip(gradient.values(), seen.values(), strict=True)
        ]
        squares = [
            [memory.square(x) * share for x, share in zip(tree.values(), shares, strict=True)]
            for tree in (seen, self.mean)
        ]
        arrays.evaluate(squares)
        square, square_of_mean = (sum(arrays.number(x) for x in s) for s in squares)
        self.second_moment = self.second_moment * _DECAY + square * (1 - _DECAY)
        self.weight = self.weight * _DECAY + (1 - _DECAY)
        if self.weight < 1 - _DECAY**10 or self.second_moment <= 0:
            return None
        mean_square = self.second_moment / self.weight
        rho = (1 - _DECAY) / (1 + _DECAY)
        noise = (mean_square - square_of_mean / self.weight**2) / (1 - rho)
        return min(max(noise / mean_square, 0.0), 1.0)


def _square(tree: Tree) -> Array:
    return sum(memory.square(x) for x in tree.values())
