"""Truncated conjugate gradients in a trust region: solve H s = −g approximately, from products of H with vectors."""

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
    """Return a step s with ‖s‖ <= `trust_radius` that approximates −H⁻¹ g (Fletcher and Reeves 1964, Steihaug 1983).

    Starts from s = 0 and v = r = −g. Each iteration computes α = rᵀr / vᵀHv, s += α v, r' = r − α H v and v = r' + (r'ᵀr' / rᵀr) v.
    `optimizers.NewtonCG` documents the stopping rules and the treatment of products that are noisy, asymmetric or of negative curvature.

    Args:
        gradient: g, (n,).
        product: function of v (n,) that returns H v (n,).
        trust_radius: largest length of the step, > 0.
        iterations: maximum number of products, >= 1.
        tolerance: ratio of the residual's norm to the gradient's norm at which the iteration stops, in [0, 1).
        damping: smallest allowed ratio of a direction's curvature to the largest curvature so far, in [0, 1).

    Returns:
        The step, (n,); the zero vector if the gradient is zero or any of its elements is not finite.
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
    a, b = float(v @ v), float(step @ v)
    c = float(step @ step) - radius**2
    return (-b + math.sqrt(max(b * b - a * c, 0.0))) / a
