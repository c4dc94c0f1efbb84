"""Statistics that compare two pictures, or a remembered picture with a fresh one, by their noise alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

_TILES, _ROBUST = 48, 1.8
"""Most tiles of a picture; most that the sharp score may exceed the robust one by."""


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
        score: the sum of the tiles' products in units of its standard deviation, which is estimated in two ways: from the contrast
            within pairs of pixels, and from the products themselves. The first is sharp. The second is large where single tiles have
            most of the sum, and bounds the score to 1.8 times itself. Noise that is independent from pixel to pixel scores above 4.5
            less than once in 10,000, also with heavy tails.
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
        total, largest = float(variances.sum()), float(variances.max(initial=0.0))
    if not math.isfinite(total):
        return Difference(value, math.inf, 1.0)
    shares = variances / largest if largest > 0 else variances
    degrees = float(shares.sum() ** 2 / (shares**2).sum()) * (groups - 1) if largest > 0 else math.inf
    return Difference(value, math.sqrt(total), degrees)


def systematic(
    values: np.ndarray, weights: np.ndarray | None = None, earlier: np.ndarray | None = None
) -> SystematicDifference:
    """Return the part of differences that neighbouring pixels share.

    Two interleaved halves of each tile have independent noise, so the product of their means has none on average.

    Args:
        values: (N, C), differences of pixels in an order where neighbours in the picture are mostly neighbours.
        earlier: (N, C), the same at an earlier step, from which the second halves are taken: what changes from step to step is not
            counted. None takes them from `values`.
        weights: (N,), how much each pixel counts, in [0, 1]; None for all alike.
    """
    count = len(values) // 2 * 2
    weight = np.ones(len(values)) if weights is None else np.asarray(weights, np.float64)
    kept = weight[:count].reshape(-1, 2).min(axis=1) > 0

    def paired(differences: np.ndarray) -> np.ndarray:
        return (np.asarray(differences, np.float64) * weight[:, None])[:count].reshape(-1, 2, values.shape[1])[kept]

    pairs = paired(values)
    if earlier is not None:
        pairs = np.stack([pairs[:, 0], paired(earlier)[:, 1]], axis=1)
    if len(pairs) == 0:
        return SystematicDifference(0.0, 0.0)
    starts = np.linspace(0, len(pairs), min(len(pairs), _TILES), endpoint=False).astype(np.int64)
    sizes = np.diff([*starts, len(pairs)])[:, None]
    halves = np.add.reduceat(pairs, starts, axis=0) / sizes[..., None]
    products = (halves[:, 0] * halves[:, 1] * sizes).sum(axis=1)
    square = float(products.sum() / (sizes.sum() * values.shape[1]))
    contrast = (np.add.reduceat((pairs[:, 0] - pairs[:, 1]) ** 2 / 2, starts, axis=0) / sizes).sum(axis=1)
    sharp, robust = (float(np.sqrt((parts**2).sum())) for parts in (contrast, products))
    if not (sharp > 0 and robust > 0):
        return SystematicDifference(square, math.inf if square > 0 else 0.0)
    total = float(products.sum())
    return SystematicDifference(square, min(total / sharp, _ROBUST * total / robust))
