"""Fraction of noise in the gradient, from the estimator's variance or from successive gradients."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

from unrender.core import arrays, memory, trees
from unrender.core.trees import Tree

_DECAY = 0.9
_EVERY = 7
"""Stride at which elements of large arrays are sampled, to save the memory of a mean gradient."""


@dataclass
class GradientNoise:
    """Estimate of the fraction of noise in the gradient's second moment E‖g‖², from exponential means over about ten steps.

    With decay a, the squared norm of the mean is ‖ḡ‖² + ρ N for total variance N and ρ = (1 - a) / (1 + a). N follows from it and from
    the second moment ‖ḡ‖² + N. A true change of the gradient within ten steps counts as noise, so this is a diagnostic, not an estimate.
    For arrays of a million elements or more, every seventh is sampled.

    Attributes:
        mean: exponentially weighted mean of the gradients, or of their samples; None before the first; with a variance, of `whole` only.
        second_moment, weight: the same of ‖g‖², and the sum of the weights.
    """

    mean: Tree | None = None
    second_moment: float = 0.0
    weight: float = 0.0

    def update(self, gradient: Tree, variance: Tree | None = None, whole: Collection[str] = ()) -> float | None:
        """Add a gradient, and return the fraction in [0, 1]; None for fewer than ten gradients without variance, and for a zero gradient.

        With the estimator's variance, the result is its fraction of ‖g‖². Gradients of an estimator that reuses earlier samples resemble
        each other, and would otherwise appear free of noise. The parameters `whole` always have a full mean, for `free_of_bounds`.
        """
        sampled = self._follow(gradient if variance is None else {key: gradient[key] for key in whole}, whole)
        if variance is not None:
            sums = sum(map(arrays.total, variance.values())), sum(map(memory.square, gradient.values()))
            arrays.evaluate(sums)
            noise, square = (arrays.number(x) for x in sums)
            return min(noise / square, 1.0) if square > 0 else None
        shares = [
            math.prod(arrays.shape(g)) / math.prod(arrays.shape(x))
            for g, x in zip(gradient.values(), sampled.values(), strict=True)
        ]
        squares = [
            [memory.square(x) * share for x, share in zip(tree.values(), shares, strict=True)]
            for tree in (sampled, self.mean or {})
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

    def _follow(self, gradient: Tree, whole: Collection[str]) -> Tree:
        """Add a gradient to the mean, and return it, or its samples."""
        some = {key for key, g in gradient.items() if memory.is_large(g) and key not in whole}
        sampled = {key: memory.every(g, _EVERY) if key in some else g for key, g in gradient.items()}
        if not sampled:
            return sampled
        if self.mean is None or trees.shapes(self.mean) != trees.shapes(sampled):
            self.mean, self.second_moment, self.weight = trees.zeros_like(sampled), 0.0, 0.0
        self.mean = trees.map(lambda m, g: m * _DECAY + g * (1 - _DECAY), self.mean, sampled)
        arrays.evaluate(self.mean, sampled)
        return sampled
