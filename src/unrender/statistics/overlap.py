"""Overlap of the cells of a texture or grid: how far elements of a matrix beside the diagonal are as large as those on it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

_ERRORS = 3.0
"""Standard errors by which the diagonal must exceed 0, and the overlap of all cells that of neighbours."""


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
    """Return the standard error of an estimate from those without each of n samples, (n,)."""
    return math.sqrt((len(without) - 1) * float(np.var(without)))
