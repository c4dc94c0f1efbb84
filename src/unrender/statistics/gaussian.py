"""Derivatives of a Gaussian as convolution kernels, their sampling densities and sampling routines.

Follows Wang et al., "Stochastic Gradient Estimation for Higher-order Differentiable Rendering", section 3. Coordinates are in units of σ:
z = τ / σ per dimension, so that S f(θ) = E[f(θ − σ z)] for standard normal z. With φ(z) the standard normal density in n dimensions,

    ∂ᵢ S f(θ)  = ∫ gᵢ(z) φ(z) f(θ − σ z) dz,     gᵢ  = −zᵢ / σᵢ                                            (Eq. 17)
    ∂ᵢⱼ S f(θ) = ∫ hᵢⱼ(z) φ(z) f(θ − σ z) dz,    hᵢᵢ = (zᵢ² − 1) / σᵢ²,   hᵢⱼ = zᵢ zⱼ / (σᵢ σⱼ)              (Eq. 20)

A kernel is sampled in proportion to its magnitude: the dimensions it depends on by the positivised kernel, the others as standard
normals. The *aggregate* samples the mixture of the densities of all elements with equal probabilities and weights every element by the
mixture's density. One sample, and one evaluation of f, then serves all elements.

Eq. 18 as printed has a logarithm of the wrong sign in its second branch and lacks a factor. The inverse is ∓√(−2 log(2 ξ)) and, for ξ >
1/2, ±√(−2 log(2 (1 − ξ))). Eq. 21 is correct.
"""

from __future__ import annotations

from functools import cache

import numpy as np

__all__ = [
    "CURVATURE_MASS",
    "GRADIENT_MASS",
    "curvature_density",
    "curvature_distribution",
    "curvature_sample",
    "gradient_density",
    "gradient_kernel",
    "gradient_mixture",
    "gradient_ratio",
    "gradient_sample",
    "hessian_kernel",
    "hessian_mixture",
    "hessian_ratio",
    "joint_mixture",
    "joint_ratio",
]

_TABLE_REACH = 10.0
_TABLE_SIZE = 20_001

GRADIENT_MASS = float(np.sqrt(2 / np.pi))
"""Normalisation constant of the positivised first-derivative kernel, ∫ |z| φ(z) dz."""

CURVATURE_MASS = float(4 * np.exp(-0.5) / np.sqrt(2 * np.pi))
"""Normalisation constant of the positivised second-derivative kernel, ∫ |z² − 1| φ(z) dz."""


def gradient_density(z: np.ndarray) -> np.ndarray:
    """Return |z| φ(z) / ∫ |z| φ, the density that samples −z φ(z), per element."""
    return 0.5 * np.abs(z) * np.exp(-0.5 * z * z)


def gradient_sample(u: np.ndarray) -> np.ndarray:
    """Return the inverse distribution function of `gradient_density` at u in (0, 1)."""
    tail = np.minimum(u, 1 - u)
    return np.sign(u - 0.5) * np.sqrt(-2 * np.log(np.maximum(2 * tail, np.finfo(float).tiny)))


def curvature_density(z: np.ndarray) -> np.ndarray:
    """Return |z² − 1| φ(z) / ∫ |z² − 1| φ, the density that samples the diagonal of the Hessian kernel, per element."""
    return 0.25 * np.abs(z * z - 1) * np.exp(0.5 - 0.5 * z * z)


def curvature_distribution(z: np.ndarray) -> np.ndarray:
    """Return the distribution function of `curvature_density` (Eq. 21)."""
    part = 0.25 * z * np.exp(0.5 - 0.5 * z * z)
    return np.where(z < -1, -part, np.where(z > 1, 1 - part, 0.5 + part))


def curvature_sample(u: np.ndarray) -> np.ndarray:
    """Return the inverse of `curvature_distribution` at u in (0, 1), which has no closed form, from 20 001 values on [−10, 10]."""
    z, distribution = _table()
    return np.interp(u, distribution, z)


@cache
def _table() -> tuple[np.ndarray, np.ndarray]:
    z = np.linspace(-_TABLE_REACH, _TABLE_REACH, _TABLE_SIZE)
    return z, np.maximum.accumulate(curvature_distribution(z))


def gradient_kernel(z: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return gᵢ(z) for all i: z (B, n), σ (n,) -> (B, n)."""
    return -z / sigma


def hessian_kernel(z: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return hᵢⱼ(z) for all i and j: z (B, n), σ (n,) -> (B, n, n)."""
    scaled = z / sigma
    return scaled[:, :, None] * scaled[:, None, :] - np.diag(1 / sigma**2)


def gradient_ratio(z: np.ndarray) -> np.ndarray:
    """Return the mixture density over the gradient's elements divided by φ(z): (B, n) -> (B,)."""
    return np.mean(np.abs(z), axis=-1) / GRADIENT_MASS


def hessian_ratio(z: np.ndarray) -> np.ndarray:
    """Return the mixture density over the n² Hessian elements divided by φ(z): (B, n) -> (B,), in O(n) per sample."""
    n = z.shape[-1]
    square = z * z
    diagonal = np.abs(square - 1).sum(-1) / CURVATURE_MASS
    magnitude = np.abs(z).sum(-1)
    off_diagonal = (magnitude * magnitude - square.sum(-1)) / GRADIENT_MASS**2  # both triangles
    return (diagonal + off_diagonal) / n**2


def gradient_mixture(chosen: np.ndarray, u: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Sample the mixture over the gradient's elements; returns z (B, n).

    Args:
        chosen: (B,), uniform numbers in [0, 1) that select the element.
        u: (B, n), uniform numbers in (0, 1), of which those of the selected dimensions are used.
        normal: (B, n), standard normals for the other dimensions.
    """
    n = normal.shape[1]
    z, rows = normal.copy(), np.arange(len(normal))
    element = np.minimum((chosen * n).astype(int), n - 1)
    z[rows, element] = gradient_sample(u[rows, element])
    return z


def hessian_mixture(chosen: np.ndarray, u: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Sample the mixture over the n² Hessian elements; arguments and result are those of `gradient_mixture`."""
    n = normal.shape[1]
    z, rows = normal.copy(), np.arange(len(normal))
    element = np.minimum((chosen * n * n).astype(int), n * n - 1)
    i, j = element // n, element % n
    z[rows, i] = np.where(i == j, curvature_sample(u[rows, i]), gradient_sample(u[rows, i]))
    off = i != j
    z[rows[off], j[off]] = gradient_sample(u[rows[off], j[off]])
    return z


def joint_ratio(z: np.ndarray) -> np.ndarray:
    """Return the density of the equal mixture of both aggregates divided by φ(z): (B, n) -> (B,)."""
    return 0.5 * (gradient_ratio(z) + hessian_ratio(z))


def joint_mixture(chosen: np.ndarray, u: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Sample the equal mixture of both aggregates; arguments and result are those of `gradient_mixture`."""
    first = chosen < 0.5
    rest = np.where(first, 2 * chosen, 2 * chosen - 1)
    return np.where(first[:, None], gradient_mixture(rest, u, normal), hessian_mixture(rest, u, normal))
