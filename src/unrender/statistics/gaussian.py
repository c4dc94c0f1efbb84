"""Derivatives of a Gaussian as convolution kernels, the densities that sample them, and how (Wang et al.,
"Stochastic Gradient Estimation for Higher-order Differentiable Rendering", section 3).

Everything is in units of σ: z = τ / σ, per dimension, so that S f(θ) = E[f(θ − σ z)] for standard normal z. With
φ(z) the standard normal density of n dimensions,

    ∂ᵢ S f(θ)  = ∫ gᵢ(z) φ(z) f(θ − σ z) dz,     gᵢ  = −zᵢ / σᵢ                                            (Eq. 17)
    ∂ᵢⱼ S f(θ) = ∫ hᵢⱼ(z) φ(z) f(θ − σ z) dz,    hᵢᵢ = (zᵢ² − 1) / σᵢ²,   hᵢⱼ = zᵢ zⱼ / (σᵢ σⱼ)              (Eq. 20)

A kernel is sampled in proportion to its magnitude: its own dimensions by the positivised kernel, the others as standard normals. The
*aggregate* samples the mixture of the densities of all elements with equal chances, and every element is weighted by the mixture's
density: one draw, and one evaluation of f, for all of them.

The paper's Eq. 18 as printed has a logarithm of the wrong sign in its second branch and lacks a factor; the inverse is
∓√(−2 log(2 ξ)) and, for ξ > 1/2, ±√(−2 log(2 (1 − ξ))). Eq. 21 is right.
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
"""∫ |z| φ(z) dz."""

CURVATURE_MASS = float(4 * np.exp(-0.5) / np.sqrt(2 * np.pi))
"""∫ |z² − 1| φ(z) dz."""


def gradient_density(z: np.ndarray) -> np.ndarray:
    """|z| φ(z) / ∫ |z| φ: what samples −z φ(z), per element."""
    return 0.5 * np.abs(z) * np.exp(-0.5 * z * z)


def gradient_sample(u: np.ndarray) -> np.ndarray:
    """The inverse of its distribution function, for u in (0, 1)."""
    tail = np.minimum(u, 1 - u)
    return np.sign(u - 0.5) * np.sqrt(-2 * np.log(np.maximum(2 * tail, np.finfo(float).tiny)))


def curvature_density(z: np.ndarray) -> np.ndarray:
    """|z² − 1| φ(z) / ∫ |z² − 1| φ: what samples the diagonal of the Hessian kernel."""
    return 0.25 * np.abs(z * z - 1) * np.exp(0.5 - 0.5 * z * z)


def curvature_distribution(z: np.ndarray) -> np.ndarray:
    """Its distribution function (Eq. 21)."""
    part = 0.25 * z * np.exp(0.5 - 0.5 * z * z)
    return np.where(z < -1, -part, np.where(z > 1, 1 - part, 0.5 + part))


def curvature_sample(u: np.ndarray) -> np.ndarray:
    """Its inverse for u in (0, 1), which has no closed form: linear between 20 001 tabulated values on [−10, 10]."""
    z, distribution = _table()
    return np.interp(u, distribution, z)


@cache
def _table() -> tuple[np.ndarray, np.ndarray]:
    z = np.linspace(-_TABLE_REACH, _TABLE_REACH, _TABLE_SIZE)
    return z, np.maximum.accumulate(curvature_distribution(z))


def gradient_kernel(z: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """gᵢ(z) of all i: z (B, n), σ (n,) to (B, n)."""
    return -z / sigma


def hessian_kernel(z: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """hᵢⱼ(z) of all i and j: z (B, n), σ (n,) to (B, n, n)."""
    scaled = z / sigma
    return scaled[:, :, None] * scaled[:, None, :] - np.diag(1 / sigma**2)


def gradient_ratio(z: np.ndarray) -> np.ndarray:
    """The mixture over the gradient's elements divided by φ(z): (B, n) to (B,)."""
    return np.mean(np.abs(z), axis=-1) / GRADIENT_MASS


def hessian_ratio(z: np.ndarray) -> np.ndarray:
    """The mixture over the n² elements of the Hessian divided by φ(z): (B, n) to (B,), in O(n) a draw."""
    n = z.shape[-1]
    square = z * z
    diagonal = np.abs(square - 1).sum(-1) / CURVATURE_MASS
    magnitude = np.abs(z).sum(-1)
    off_diagonal = (magnitude * magnitude - square.sum(-1)) / GRADIENT_MASS**2  # both triangles
    return (diagonal + off_diagonal) / n**2


def gradient_mixture(chosen: np.ndarray, u: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Draws from the mixture over the gradient's elements.

    Args:
        chosen: (B,) uniform numbers that choose the element.
        u: (B, n) uniform numbers; those of the chosen dimension are used.
        normal: (B, n) standard normals for the others.
    """
    n = normal.shape[1]
    z, rows = normal.copy(), np.arange(len(normal))
    element = np.minimum((chosen * n).astype(int), n - 1)
    z[rows, element] = gradient_sample(u[rows, element])
    return z


def hessian_mixture(chosen: np.ndarray, u: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Draws from the mixture over the n² elements of the Hessian; the arguments are those of `gradient_mixture`."""
    n = normal.shape[1]
    z, rows = normal.copy(), np.arange(len(normal))
    element = np.minimum((chosen * n * n).astype(int), n * n - 1)
    i, j = element // n, element % n
    z[rows, i] = np.where(i == j, curvature_sample(u[rows, i]), gradient_sample(u[rows, i]))
    off = i != j
    z[rows[off], j[off]] = gradient_sample(u[rows[off], j[off]])
    return z


def joint_ratio(z: np.ndarray) -> np.ndarray:
    """The mixture of both aggregates, half of each, divided by φ(z): (B, n) to (B,)."""
    return 0.5 * (gradient_ratio(z) + hessian_ratio(z))


def joint_mixture(chosen: np.ndarray, u: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Draws from the mixture of both aggregates; the arguments are those of `gradient_mixture`."""
    first = chosen < 0.5
    rest = np.where(first, 2 * chosen, 2 * chosen - 1)
    return np.where(first[:, None], gradient_mixture(rest, u, normal), hessian_mixture(rest, u, normal))
