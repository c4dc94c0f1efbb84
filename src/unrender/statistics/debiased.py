"""The error of a rendered picture without the noise of its own rendering."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from unrender.core.errors import InputError


def rmse(
    first: np.ndarray, second: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None
) -> tuple[float, float]:
    """The root mean square difference between what a picture converges to and its reference, from two independent renderings of it.

    With renderings A and B of expectation I, the mean of (A - R)(B - R) over pixels and channels is an unbiased estimate of the mean of
    (I - R)², where the error of their mean alone would be larger by its variance. Noise of the reference counts as error.

    Args:
        first, second: (H, W, C), equally noisy and independent; the noise of a pixel is independent of other pixels'.
        reference: (H, W, C).
        mask: (H, W), in [0, 1]: by how much each pixel counts. None for all alike.

    Returns:
        The root of that mean, 0 where it is negative or no pixel counts, and its standard error; both infinite where a value is not
        finite. The variance of the mean is estimated in two ways, neither of which is low, and the smaller one is taken: from
        ((A + B)/2 - R)·(A - B) of each pixel, too large where noise has heavy tails, and from the spread of (A - R)·(B - R) over pixels,
        too large where errors differ from pixel to pixel. Where the error is within two standard errors of 0, the second number is the
        root of two standard errors of the mean square: what the error may well be.

    Raises:
        InputError: the pictures, or the mask, have different sizes.
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
        bounds = np.sum(((a + b) / 2 - r) * (a - b), axis=2), products - square * a.shape[2]
        error = math.sqrt(min(float(np.sum((weight * bound) ** 2)) for bound in bounds)) / count
    if not (math.isfinite(square) and math.isfinite(error)):
        return math.inf, math.inf
    value = math.sqrt(max(square, 0.0))
    return value, error / (2 * value) if square > 2 * error else math.sqrt(2 * error)


def mean(errors: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The mean of independent values, each with its standard error, and the mean's own; at least one."""
    values, own = np.array(errors, float).T
    return float(values.mean()), float(np.sqrt((own**2).sum())) / len(values)
