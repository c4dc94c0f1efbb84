"""Statistics that compare two pictures, or a remembered picture with a fresh one, by their noise alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

__all__ = [
    "Difference",
    "SystematicDifference",
    "difference",
    "leave_one_out",
    "mean_and_error",
    "pseudo_values",
    "systematic",
]

_FEW_TILES, _MANY_TILES = 40, 48
"""Number of tiles below which colour channels are tiles of their own, and above which tiles grow."""


@dataclass(frozen=True)
class Difference:
    """The difference of two losses.

    Attributes:
        value: the second loss minus the first.
        standard_error: of `value`; infinite where it cannot be estimated.
        degrees: degrees of freedom of the standard error (Welch and Satterthwaite).
    """

    value: float
    standard_error: float
    degrees: float

    def exceeds_noise(self, level: float) -> bool:
        """Return whether the difference is positive by a one-sided t-test whose false positive rate is `level`."""
        if math.isnan(self.value) or math.isinf(self.standard_error):
            return False
        if math.isinf(self.value):
            return self.value > 0
        return self.value > -float(stdtrit(max(self.degrees, 1.0), level)) * self.standard_error


@dataclass(frozen=True)
class SystematicDifference:
    """The part of the difference of two pictures that neighbouring pixels share.

    Attributes:
        mean_square: unbiased estimate of its mean square per channel; may be negative.
        score: the estimate over the root of its sum of squares. Where noise is symmetric and independent from pixel to pixel, a score
            above z has a probability of at most exp(-z²/2).
    """

    mean_square: float
    score: float


def leave_one_out(images: np.ndarray) -> np.ndarray:
    """Return for each of K >= 2 images (K, ...) the mean of the others."""
    count = len(images)
    return (images.mean(axis=0) * count - images) / (count - 1)


def pseudo_values(whole: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """Return the jackknife's pseudo-values (K, N) of N losses.

    Their mean over K is the loss without the noise of the image: exactly where the loss is quadratic, to second order otherwise.

    Args:
        whole: (N,), the losses of the mean of K images.
        left_out: (K, N), the losses of the mean of all images but one.
    """
    count = len(left_out)
    return count * whole - (count - 1) * left_out


def mean_and_error(pseudo: np.ndarray) -> tuple[float, float]:
    """Return the sum of N losses from pseudo-values (K, N), and its standard error from the spread of each over K."""
    found = difference(np.zeros_like(pseudo), pseudo)
    return found.value, found.standard_error


def difference(first: np.ndarray, second: np.ndarray, sampled: bool = False) -> Difference:
    """Return how much larger the sum of the second losses is, from pseudo-values (K, N) on equal random numbers.

    Args:
        first, second: pseudo-values of N independent parts of a loss.
        sampled: whether the N parts are a random sample of many. The standard error is then that of their sum, from the spread of all
            parts; otherwise it is from the spread of each part over its K pseudo-values.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        changes = second - first
        groups, parts = changes.shape
        mean = changes.mean(axis=0)
        value = float(mean.sum())
        if sampled:
            if parts < 2:
                return Difference(value, math.inf, 1.0)
            return Difference(value, math.sqrt(parts * float(mean.var(ddof=1))), parts - 1.0)
        variances = changes.var(axis=0, ddof=1) / groups
        total, squares = float(variances.sum()), float((variances**2).sum())
    degrees = total**2 / squares * (groups - 1) if squares > 0 else math.inf
    return Difference(value, math.sqrt(total), degrees)


def systematic(values: np.ndarray, weights: np.ndarray | None = None) -> SystematicDifference:
    """Return the part of differences that neighbouring pixels share.

    Two interleaved halves of each tile have independent noise, so the product of their means has none on average.

    Args:
        values: (N, C), differences of pixels in an order where neighbours in the picture are mostly neighbours.
        weights: (N,), how much each pixel counts, in [0, 1]; None for all alike.
    """
    count = len(values) // 2 * 2
    weight = np.ones(len(values)) if weights is None else np.asarray(weights, np.float64)
    kept = weight[:count].reshape(-1, 2).min(axis=1) > 0
    pairs = (np.asarray(values, np.float64) * weight[:, None])[:count].reshape(-1, 2, values.shape[1])[kept]
    if len(pairs) == 0:
        return SystematicDifference(0.0, 0.0)
    starts = np.linspace(0, len(pairs), min(len(pairs), _MANY_TILES), endpoint=False).astype(np.int64)
    sizes = np.diff([*starts, len(pairs)])[:, None]
    halves = np.add.reduceat(pairs, starts, axis=0) / sizes[..., None]
    products = halves[:, 0] * halves[:, 1] * sizes
    square = float(products.sum() / (sizes.sum() * products.shape[1]))
    parts = products.ravel() if len(starts) < _FEW_TILES else products.sum(axis=1)
    norm = float(np.sqrt((parts**2).sum()))
    return SystematicDifference(square, float(parts.sum()) / norm if norm > 0 else 0.0)
