"""Normal distributions of isotropic rough surfaces, and the parts in which they grow and shrink with their roughness.

Symbols: α roughness, D density of normals per solid angle and projected area, θ a normal's angle, t = tan²θ / α² its squared slope in
units of α. D cosθ is a density of directions: its integral is 1 whatever α, so that of ∂D/∂α cosθ is 0. The derivative is negative
for t < 1, the inner part, and positive beyond, the outer part, which has as much mass (Belhe et al. 2024, the same cut at the sign change).
Of u in (0, 1] both parts have the same share of their mass between t(u) and 1: pairs of normals, one in each part, that belong together.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

from unrender.core import arrays
from unrender.core.arrays import Array


class NormalDistribution(ABC):
    """One family of isotropic distributions. Arrays of any kind, per element; α > 0, t >= 0."""

    @abstractmethod
    def density(self, alpha: Array, t: Array) -> Array:
        """D, per steradian."""

    @abstractmethod
    def log_derivative(self, alpha: Array, t: Array) -> Array:
        """∂ log D / ∂α at a normal that stays where it is: negative for t < 1, positive for t > 1."""

    @abstractmethod
    def mass(self, alpha: Array) -> Array:
        """∫ |∂D/∂α| cosθ dω over the inner part, and over the outer."""

    @abstractmethod
    def parts(self, u: Array) -> tuple[Array, Array]:
        """t of a normal of the inner part, and of one of the outer, in proportion to |∂D/∂α| cosθ, from one uniform number in (0, 1];
        near 1 for u near 1."""

    def share(self, t: Array) -> Array:
        """|∂ log D / ∂α| / mass, which does not depend on α: D cosθ times it is the density that `parts` samples either part with."""
        return arrays.absolute(self.log_derivative(1.0, t)) / self.mass(1.0)


class GGX(NormalDistribution):
    """D = 1 / (π α² cos⁴θ (1 + t)²)."""

    def density(self, alpha: Array, t: Array) -> Array:
        squared = alpha * alpha
        over = (1.0 + squared * t) / (1.0 + t)
        return over * over / (math.pi * squared)

    def log_derivative(self, alpha: Array, t: Array) -> Array:
        return 2.0 * (t - 1.0) / ((t + 1.0) * alpha)

    def mass(self, alpha: Array) -> Array:
        """See `NormalDistribution.mass`: the share of the normals up to t is t / (1 + t), its derivative -2 t / (α (1 + t)²)."""
        return 0.5 / alpha

    def parts(self, u: Array) -> tuple[Array, Array]:
        """See `NormalDistribution.parts`: the roots of 4 t = u (1 + t)², one the inverse of the other."""
        root = 1.0 + arrays.sqrt(arrays.maximum(1.0 - u, 0.0))
        return u / (root * root), root * root / arrays.maximum(u, 1e-12)


class Beckmann(NormalDistribution):
    """D = exp(-t) / (π α² cos⁴θ)."""

    def density(self, alpha: Array, t: Array) -> Array:
        squared = alpha * alpha
        over = 1.0 + squared * t
        return over * over * arrays.exp(-t) / (math.pi * squared)

    def log_derivative(self, alpha: Array, t: Array) -> Array:
        return 2.0 * (t - 1.0) / alpha

    def mass(self, alpha: Array) -> Array:
        """See `NormalDistribution.mass`: the share of the normals up to t is 1 - exp(-t), its derivative -2 t exp(-t) / α."""
        return 2.0 / (math.e * alpha)

    def parts(self, u: Array) -> tuple[Array, Array]:
        """See `NormalDistribution.parts`: the roots of t exp(1 - t) = u, both branches of Lambert's W. Relative error of u below 2e-5."""
        y = -arrays.log(arrays.clip(u, 1e-12, 1.0))  # t - 1 - log t
        s = arrays.sqrt(2.0 * y)
        near = s < 0.8
        # Newton's steps away from t = 1, where they lose their digits: on log t within, on t beyond.
        inner = arrays.minimum(-1.0 - y + arrays.exp(-1.0 - y), -0.5)
        outer = arrays.maximum(1.0 + s + y * (2.0 / 3.0), 1.5)
        for _ in range(3):
            power = arrays.exp(inner)
            inner = arrays.minimum(inner - (inner - power + 1.0 + y) / (1.0 - power), -0.5)
            outer = arrays.maximum(outer - (outer - 1.0 - arrays.log(outer) - y) * outer / (outer - 1.0), 1.5)
        return (
            arrays.where(near, _around_one(-arrays.minimum(s, 0.8)), arrays.exp(inner)),
            arrays.where(near, _around_one(arrays.minimum(s, 0.8)), outer),
        )


def _around_one(s: Array) -> Array:
    """t where t - 1 - log t = s² / 2 and t - 1 has the sign of s, |s| <= 0.8: its power series."""
    terms = (1.0, 1.0, 1.0 / 3.0, 1.0 / 36.0, -1.0 / 270.0, 1.0 / 4320.0, 1.0 / 17010.0)
    found = s * 0.0 + terms[-1]
    for term in reversed(terms[:-1]):
        found = found * s + term
    return found
