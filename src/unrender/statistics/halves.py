"""Least squares of noisy images, from two independent halves of their samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["normal_equations"]


def normal_equations(
    parts: Sequence[np.ndarray], residuals: Sequence[np.ndarray], weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return A and b of min_f Σ w (Σ_k f_k D_k − r)², which is solved by A f = b; (K, K) and (K,).

    Products of two independent halves do not contain squared noise, so neither A nor b is biased. Pixels that are not finite are left out.

    Args:
        parts: D of each half, (K, ..., 3) each.
        residuals: r of each half, (..., 3) each.
        weights: w, which can be broadcast to (..., 3), >= 0.
    """
    finite = np.isfinite([*residuals, *parts[0], *parts[1]]).all(axis=0).all(axis=-1, keepdims=True)
    used = np.broadcast_to(np.where(finite, weights, 0.0), residuals[0].shape).reshape(-1)
    one, other = (np.nan_to_num(x, posinf=0.0, neginf=0.0).reshape(len(x), -1) for x in parts)
    r_one, r_other = (np.nan_to_num(x, posinf=0.0, neginf=0.0).reshape(-1) * used for x in residuals)
    matrix = (one * used) @ other.T
    return 0.5 * (matrix + matrix.T), 0.5 * (one @ r_other + other @ r_one)
