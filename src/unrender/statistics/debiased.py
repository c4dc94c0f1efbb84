"""Errors, least squares and overlaps from independent halves, without the bias from Monte Carlo noise."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from unrender.core.errors import InputError


def rmse(
    first: np.ndarray, second: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None
) -> tuple[float, float]:
    """Return the root mean square error of an image's expectation, from two independent renderings of it.

    For renderings A and B with expectation I, the mean of (A − R)(B − R) over pixels and channels is an unbiased estimate of the mean of
    (I − R)². The squared error of (A + B)/2 would be larger by its variance. Noise of the reference R counts as error.

    Args:
        first, second: (H, W, C), independent renderings of equal noise; noise is independent between pixels.
        reference: (H, W, C).
        mask: weight of each pixel, (H, W), in [0, 1]; None for equal weights. Values of pixels with weight 0 are ignored.

    Returns:
        The root of that mean and its standard error. The root is 0 where the mean is negative or no pixel counts. Both are infinite if a
        value is not finite.

        The variance of the mean is the smaller of two estimates, both of which are conservative. The first uses ((A + B)/2 − R)·(A − B)
        of each pixel and is too large for heavy-tailed noise. The second uses the spread of (A − R)·(B − R) over pixels and is too large
        if errors differ between pixels. If the mean square is within two standard errors of 0, the second returned number is the root of
        two of its standard errors, an upper bound of the error.

    Raises:
        InputError: the images, or an image and the mask, differ in size.
    """
    a, b, r = (np.asarray(x, np.float64) for x in (first, second, reference))
    if not (a.shape == b.shape == r.shape and a.ndim == 3 and a.size):
        raise InputError(f"metrics: expected three pictures of one size, got {a.shape}, {b.shape} and {r.shape}")
    weight = np.ones(a.shape[:2]) if mask is None else np.asarray(mask, np.float64)
    if weight.shape != a.shape[:2]:
        raise InputError(f"metrics: expected a mask of {a.shape[:2]}, got {weight.shape}")
    count = float(weight.sum()) * a.shape[2]
    if count == 0:
        return 0.0, 0.0
    a, b, r = (np.where(weight[..., None] > 0, x, 0.0) for x in (a, b, r))
    with np.errstate(over="ignore", invalid="ignore"):
        products = np.sum((a - r) * (b - r), axis=2)
        square = float(np.sum(weight * products)) / count
        bounds = [np.sum(((a + b) / 2 - r) * (a - b), axis=2)]
        if np.count_nonzero(weight) > 1:  # a single pixel has no spread
            bounds.append(products - square * a.shape[2])
        error = math.sqrt(min(float(np.sum((weight * bound) ** 2)) for bound in bounds)) / count
    if not (math.isfinite(square) and math.isfinite(error)):
        return math.inf, math.inf
    value = math.sqrt(max(square, 0.0))
    return value, error / (2 * value) if square > 2 * error else math.sqrt(2 * error)


def mean(errors: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the mean of independent values (value, standard error), and its standard error. Needs at least one value."""
    values, own = np.array(errors, float).T
    return float(values.mean()), float(np.sqrt((own**2).sum())) / len(values)


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


_ERRORS = 3.0  # standard errors by which the diagonal must exceed 0, and the overlap of all cells that of neighbours


def overlap(stored: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return Σ_ij H_ij² / Σ_i H_ii² of H = JᵀJ, at least 1, over neighbouring cells i and j; NaN if noise hides the diagonal.

    The products of all cells are so many that noise dominates their sum. All count where their ratio exceeds that of
    neighbours significantly, such as where a mirror shows cells beside others.

    Args:
        stored: Jᵀs and again Jᵀs, (..., C) each with noise of its own, of at least three random vectors s of independent signs.
    """
    one, other = (np.stack(half).astype(np.float64) for half in zip(*stored, strict=True))
    diagonal = _squared_means(one * other)
    if diagonal[0] <= _ERRORS * _jackknife_error(diagonal[1:]):
        return np.nan
    near, axes = diagonal.copy(), one.ndim - 2
    for offset in itertools.product((-1, 0, 1), repeat=axes):
        if offset > (0,) * axes:
            here, there = (
                (slice(None), *(slice(max(0, s * o), min(0, s * o) or None) for o in offset)) for s in (1, -1)
            )
            near += 2.0 * _squared_means(0.5 * (one[here] * other[there] + one[there] * other[here]))
    for a, b in itertools.combinations(range(one.shape[-1]), 2):
        near += 2.0 * _squared_means(0.5 * (one[..., a] * other[..., b] + one[..., b] * other[..., a]))
    flat = one.reshape(len(one), -1), other.reshape(len(one), -1)
    pairs = (flat[0] @ flat[0].T) * (flat[1] @ flat[1].T)
    np.fill_diagonal(pairs, 0.0)
    everywhere = _mean_of_pairs(pairs.sum(), pairs.sum(axis=1)) / diagonal
    local = float(near[0] / diagonal[0])
    significant = everywhere[0] - _ERRORS * _jackknife_error(everywhere[1:]) > local
    return max(1.0, float(everywhere[0]) if significant else local)


def _squared_means(products: np.ndarray) -> np.ndarray:
    """Return an unbiased estimate of the sum of the squared means of n products (n, ...), and those without each one, (1 + n,)."""
    flat = products.reshape(len(products), -1)
    total, own = flat.sum(axis=0), np.square(flat).sum(axis=1)
    return _mean_of_pairs(float(total @ total) - own.sum(), flat @ total - own)


def _mean_of_pairs(total: float, rows: np.ndarray) -> np.ndarray:
    """Return the mean over ordered pairs of n probes, and those without each one, (1 + n,), from their sum and those with each one."""
    n = len(rows)
    return np.append(total / (n * (n - 1)), (total - 2.0 * rows) / ((n - 1) * (n - 2)))


def _jackknife_error(without: np.ndarray) -> float:
    return math.sqrt((len(without) - 1) * float(np.var(without)))
