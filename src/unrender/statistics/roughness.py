"""Microfacet normal distributions of isotropic rough surfaces, and their derivative with respect to roughness.

Symbols: roughness α; normal distribution D; angle θ between microfacet normal and surface normal; t = tan²θ / α², the squared slope in
units of α. D cosθ is a density over directions with integral 1 for every α, so (∂D/∂α) cosθ has integral 0. The derivative is negative in
the inner part, t < 1, and positive in the outer part, t > 1. Both parts have the same mass. Belhe et al. 2024 cut at the same sign change.
For u in (0, 1], both parts have the same fraction of their mass between t(u) and 1, which pairs each inner normal with an outer one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

from unrender.core import arrays
from unrender.core.arrays import Array


class NormalDistribution(ABC):
    """A family of isotropic normal distributions. Methods act per element on arrays of any type, with α > 0 and t >= 0."""

    @abstractmethod
    def density(self, alpha: Array, t: Array) -> Array:
        """Return D, per steradian."""

    @abstractmethod
    def log_derivative(self, alpha: Array, t: Array) -> Array:
        """Return ∂ log D / ∂α at a fixed normal: negative for t < 1, positive for t > 1."""

    @abstractmethod
    def mass(self, alpha: Array) -> Array:
        """Return ∫ |∂D/∂α| cosθ dω over the inner part, which equals that over the outer part."""

    @abstractmethod
    def parts(self, u: Array) -> tuple[Array, Array]:
        """Sample t of an inner and an outer normal in proportion to |∂D/∂α| cosθ from u in (0, 1]; both are near 1 for u near 1."""

    def share(self, t: Array) -> Array:
        """Return |∂ log D / ∂α| / mass, which is independent of α. Times D cosθ it is the density of `parts` for either part."""
        return arrays.absolute(self.log_derivative(1.0, t)) / self.mass(1.0)


class GGX(NormalDistribution):
    """GGX distribution, D = 1 / (π α² cos⁴θ (1 + t)²)."""

    def density(self, alpha: Array, t: Array) -> Array:
        squared = alpha * alpha
        over = (1.0 + squared * t) / (1.0 + t)
        return over * over / (math.pi * squared)

    def log_derivative(self, alpha: Array, t: Array) -> Array:
        return 2.0 * (t - 1.0) / ((t + 1.0) * alpha)

    def mass(self, alpha: Array) -> Array:
        # The cumulative distribution in t is t / (1 + t), with derivative -2 t / (α (1 + t)²) with respect to α.
        return 0.5 / alpha

    def parts(self, u: Array) -> tuple[Array, Array]:
        # The roots of 4 t = u (1 + t)²; one is the inverse of the other.
        root = 1.0 + arrays.sqrt(arrays.maximum(1.0 - u, 0.0))
        return u / (root * root), root * root / arrays.maximum(u, 1e-12)


class Beckmann(NormalDistribution):
    """Beckmann distribution, D = exp(-t) / (π α² cos⁴θ)."""

    def density(self, alpha: Array, t: Array) -> Array:
        squared = alpha * alpha
        over = 1.0 + squared * t
        return over * over * arrays.exp(-t) / (math.pi * squared)

    def log_derivative(self, alpha: Array, t: Array) -> Array:
        return 2.0 * (t - 1.0) / alpha

    def mass(self, alpha: Array) -> Array:
        # The cumulative distribution in t is 1 - exp(-t), with derivative -2 t exp(-t) / α with respect to α.
        return 2.0 / (math.e * alpha)

    def parts(self, u: Array) -> tuple[Array, Array]:
        # The roots of t exp(1 - t) = u, by both branches of Lambert's W. The relative error of u is below 2e-5.
        y = -arrays.log(arrays.clip(u, 1e-12, 1.0))  # t - 1 - log t
        s = arrays.sqrt(2.0 * y)
        near = s < 0.8
        # Newton's method away from t = 1, where it loses precision: on log t for the inner root, on t for the outer one.
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
    """Return the solution t of t - 1 - log t = s² / 2 where t - 1 has the sign of s, for |s| <= 0.8, by its power series."""
    terms = (1.0, 1.0, 1.0 / 3.0, 1.0 / 36.0, -1.0 / 270.0, 1.0 / 4320.0, 1.0 / 17010.0)
    result = s * 0.0 + terms[-1]
    for term in reversed(terms[:-1]):
        result = result * s + term
    return result
