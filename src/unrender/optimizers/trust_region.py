"""The least value of a quadratic model within a trust region."""

from __future__ import annotations

import numpy as np

from unrender.core import vectors

__all__ = ["trust_region_step"]

_SECULAR_ITERATIONS = 60


def trust_region_step(curvatures: np.ndarray, gradient: np.ndarray, radius: float | None) -> np.ndarray:
    """The s with ‖s‖ <= radius that minimises Σ gradient s + curvatures s² / 2, all along the eigenvectors, (n,).

    Args:
        curvatures: (n,), >= 0.
        gradient: (n,), not all zero.
        radius: > 0; None for no limit.

    It is −gradient / (curvatures + λ) with the least λ >= 0 that makes it short enough (Nocedal and Wright, section 4.3). Newton's
    iteration for 1 / ‖s‖ = 1 / radius approaches λ from below.
    """
    if radius is None:
        return -gradient / curvatures
    λ = max(0.0, float(np.linalg.norm(gradient)) / radius - float(curvatures.max()))
    step = -gradient / (curvatures + λ)
    for _ in range(_SECULAR_ITERATIONS):
        length = float(np.linalg.norm(step))
        if length <= radius * (1 + 1e-10):
            break
        λ += length**2 / float(np.sum(step * step / (curvatures + λ))) * (length - radius) / radius
        step = -gradient / (curvatures + λ)
    return vectors.clip_norm(step, radius)
