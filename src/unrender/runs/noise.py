"""How much of the gradient is noise: as its estimator says, or seen from the stream of gradients alone."""

from __future__ import annotations

from dataclasses import dataclass

from unrender.core import arrays, trees
from unrender.core.trees import Tree

__all__ = ["GradientNoise"]

_DECAY = 0.9


@dataclass
class GradientNoise:
    """The share of the gradient's second moment E‖g‖² that is noise, from exponentially weighted means over about ten steps.

    With decay a, the mean's squared norm is ‖ḡ‖² + ρ N for total variance N, ρ = (1 - a) / (1 + a), so N follows from it and from
    the second moment ‖ḡ‖² + N. A gradient that truly changes within ten steps counts as noise: a diagnostic, not an estimate.
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
            sums = [
                sum(arrays.total(x) for x in tree.values()) for tree in (variance, trees.map(lambda g: g * g, gradient))
            ]
            arrays.evaluate(sums)
            noise, square = (arrays.number(x) for x in sums)
            return min(noise / square, 1.0) if square > 0 else None
        if self.mean is None or trees.shapes(self.mean) != trees.shapes(gradient):
            self.mean, self.second_moment, self.weight = trees.zeros_like(gradient), 0.0, 0.0
        self.mean = trees.map(lambda m, g: m * _DECAY + g * (1 - _DECAY), self.mean, gradient)
        squares = [arrays.total(g * g) for g in gradient.values()], [arrays.total(m * m) for m in self.mean.values()]
        arrays.evaluate(self.mean, squares)
        square, square_of_mean = (sum(arrays.number(x) for x in s) for s in squares)
        self.second_moment = self.second_moment * _DECAY + square * (1 - _DECAY)
        self.weight = self.weight * _DECAY + (1 - _DECAY)
        if self.weight < 1 - _DECAY**10 or self.second_moment <= 0:
            return None
        mean_square = self.second_moment / self.weight
        rho = (1 - _DECAY) / (1 + _DECAY)
        noise = (mean_square - square_of_mean / self.weight**2) / (1 - rho)
        return min(max(noise / mean_square, 0.0), 1.0)
