"""Truncated conjugate gradients within a trust region: an approximate solution of H s = −g from products of H with vectors."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np


def solve(
    gradient: np.ndarray,
    product: Callable[[np.ndarray], np.ndarray],
    trust_radius: float,
    iterations: int,
    tolerance: float = 0.1,
    damping: float = 0.1,
) -> np.ndarray:
    """A step s with ‖s‖ <= `trust_radius` that approximates −H⁻¹ g (Fletcher and Reeves 1964, Steihaug 1983).

    From s = 0 and v = r = −g: α = rᵀr / vᵀHv, s += α v, r −= α H v, and the next v is r + (r'ᵀr' / rᵀr) v. `optimizers.NewtonCG`
    describes when it ends, and how it treats products that are noisy, not symmetric or of negative curvature.

    Args:
        gradient: g, (n,).
        product: from v (n,) to H v (n,).
        trust_radius: the longest step, > 0.
        iterations: products at most, >= 1.
        tolerance: the residual's ratio to the gradient at which it ends, in [0, 1).
        damping: the least ratio of a direction's curvature to the greatest one met, in [0, 1).

    Returns:
        (n,); zeros where the gradient is zero or not finite.
    """
    step, residual = np.zeros_like(gradient), -gradient
    v, greatest_curvature = residual, 0.0
    initial_square = square = float(residual @ residual)
    if not math.isfinite(initial_square):
        return step
    for iteration in range(iterations):
        if not tolerance**2 * initial_square < square <= initial_square or not v @ gradient < 0.0:
            break
        hessian_v = product(v)
        if not np.isfinite(hessian_v).all():
            break
        curvature, v_square = float(v @ hessian_v), float(v @ v)
        alpha_at_radius = _alpha_at_radius(step, v, trust_radius)
        if iteration == 0 and curvature <= 0.0:
            return alpha_at_radius * v
        greatest_curvature = max(greatest_curvature, abs(curvature) / v_square)
        least_curvature = damping * greatest_curvature * v_square
        damped_curvature = max(abs(curvature), least_curvature)
        if square >= damped_curvature * alpha_at_radius:
            return step + alpha_at_radius * v
        alpha = square / damped_curvature
        step = step + alpha * v
        if curvature < least_curvature:
            break
        residual = residual - alpha * hessian_v
        previous_square, square = square, float(residual @ residual)
        v = residual + square / previous_square * v
    return step


def _alpha_at_radius(step: np.ndarray, v: np.ndarray, radius: float) -> float:
    """The α >= 0 at which step + α v lies on the sphere of that radius."""
    a, b = float(v @ v), float(step @ v)
    c = float(step @ step) - radius**2
    return (-b + math.sqrt(max(b * b - a * c, 0.0))) / a
