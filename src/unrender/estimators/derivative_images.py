"""Products of derivative images over pixels, from two independent halves, for Gauss-Newton matrices."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from unrender.statistics import scores

__all__ = [
    "DerivativeMean",
    "LossWeights",
    "NoiseMean",
    "Products",
    "differences",
    "noise_weights",
    "products",
    "squared_slope",
]

_VALUES = 1 << 22
"""Maximum number of image values that are converted to double precision at once."""
_CHANNELS = 3
_GROWTH = 1.0
"""Weights of derivative images in their mean grow as this power of their number."""
_MOST_IMAGES, _RECENT = 40.0, 0.3
"""Number of images that the mean of the noise remembers, and least weight of the latest in that of the references, which contains what the
scene does not explain yet."""


@dataclass(frozen=True)
class LossWeights:
    """Derivatives of the loss by the pixels, (H, W, 3) each.

    Attributes:
        first, second: ℓ' and ℓ'' at the image; `second` is (H, W, 3, 3) with weights that mix channels.
        one, other: ℓ' at two independent halves of the image.
    """

    first: np.ndarray
    second: np.ndarray
    one: np.ndarray
    other: np.ndarray

    def times(self, matrices: np.ndarray) -> LossWeights:
        """Return the weights for residuals √ℓ'' r that are multiplied by a symmetric matrix per pixel, (H, W, 3, 3)."""
        roots = np.sqrt(self.second)
        over = np.divide(1.0, roots, out=np.zeros_like(roots), where=roots > 0.0)
        first, one, other = (
            roots * np.einsum("hwcd,hwd->hwc", matrices, over * x) for x in (self.first, self.one, self.other)
        )
        return LossWeights(first, roots[..., None] * matrices * roots[..., None, :], one, other)


@dataclass(frozen=True)
class NoiseMean:
    """Mean noise of the residuals √ℓ'' r of a view's images, over steps.

    Attributes:
        rendering: covariance of each pixel's channels, (H, W, 3, 3).
        references: mean of r rᵀ over all pixels without rendering noise, (3, 3): the noise of the reference, and what the scene at the
            current parameters does not explain.
        images: effective number of images in the mean.
    """

    rendering: np.ndarray
    references: np.ndarray
    images: float

    @classmethod
    def of(cls, second: np.ndarray, one: np.ndarray, other: np.ndarray, before: NoiseMean | None = None) -> NoiseMean:
        """Return the mean with the noise of one more image.

        Args:
            second: ℓ'', (H, W, 3).
            one, other: residuals r of its two halves, (H, W, 3).
            before: mean of earlier images, in which recent ones have more weight; None for the first image.
        """
        roots = np.sqrt(second)
        one, other = roots * one, roots * other
        half = 0.5 * (one - other)
        rendering = half[..., :, None] * half[..., None, :]
        counted = roots.any(axis=-1).astype(np.float64)
        if before is not None and (median := _median(before.variance())) > 0.0:
            counted /= (
                1.0 + before.variance() / median
            ) ** 2  # few noisy pixels tell little about the others' references
        product = np.einsum("hw,hwc,hwd->cd", counted, one, other) / max(float(counted.sum()), 1e-300)
        references = 0.5 * (product + product.T)
        if before is None:
            return cls(rendering, references, 1.0)
        share = 2.0 / (min(before.images, _MOST_IMAGES) + 2.0)
        return cls(
            before.rendering + share * (rendering - before.rendering),
            before.references + max(share, _RECENT) * (references - before.references),
            before.images + 1.0,
        )

    def variance(self) -> np.ndarray:
        """Return the mean variance of each pixel's channels, (H, W)."""
        return np.trace(self.rendering, axis1=-2, axis2=-1) / _CHANNELS


@dataclass(frozen=True)
class DerivativeMean:
    """Weighted mean of the derivative images of a view, in two independent halves.

    The gradient Jᵀ r has the noise of r times J, and that of r times the noise of J. The mean makes the second one small for elements
    that hardly change the picture. It adds no bias, since r is of images that are independent of J.

    Attributes:
        one, other: halves, (m, H, W, 3).
        count: number of images, reduced by long steps.
    """

    one: np.ndarray
    other: np.ndarray
    count: float = 1.0

    def and_one(self, new: DerivativeMean, moved: float) -> DerivativeMean:
        """Return the mean with one more derivative image, after a step of length `moved` in units of the differences' widths."""
        usual = (1.0 + _GROWTH) / (self.count + 1.0 + _GROWTH)
        weight = max(usual, moved * moved / (1.0 + moved * moved))
        one, other = (
            (a + np.float32(weight) * (b - a)).astype(np.float32)
            for a, b in ((self.one, new.one), (self.other, new.other))
        )
        return DerivativeMean(one, other, (1.0 + _GROWTH) * (1.0 / weight - 1.0) + 1.0)


@dataclass
class Products:
    """Sums over pixels and channels, for m elements.

    Attributes:
        gradient: Σ J ℓ', (m,).
        hessian: Σ J ℓ'' Jᵀ, (m, m).
        noise: Σ N ℓ'' Nᵀ with the noise N of the mean of the halves, (m, m).
        gradient_noise: covariance of Σ J ℓ' from the noise of images and derivative images, (m, m).
        scores: covariance of Σ J ℓ' from the references' noise, (m, m), see `statistics.scores`.
        squares: diagonal of Σ J Jᵀ, (m,).
    """

    gradient: np.ndarray
    hessian: np.ndarray
    noise: np.ndarray
    gradient_noise: np.ndarray
    scores: np.ndarray
    squares: np.ndarray


def noise_weights(noise: NoiseMean, limit: float) -> np.ndarray:
    """Return the weight (1 + (Σ + R) / (c m))⁻¹ of each pixel, (H, W, 3, 3).

    Σ is the covariance of its channels, R the noise of the references, c = `limit`, and m the median of the variances above 0, a third
    of the trace of Σ. A few images tell little about nine numbers, so Σ is mixed with its mean variance by their number. The weights
    are 1 where no pixel has noise.
    """
    unit, variance = np.eye(_CHANNELS), noise.variance()
    if not variance.any():
        return np.broadcast_to(unit, noise.rendering.shape)
    known = noise.images / (noise.images + _CHANNELS)
    covariance = known * noise.rendering + (1.0 - known) * variance[..., None, None] * unit
    return np.linalg.inv(unit + (covariance + scores.positive_part(noise.references)) / (limit * _median(variance)))


def _median(variance: np.ndarray) -> float:
    """Return the median of the variances above 0; 0 if there is none."""
    noisy = variance[variance > 0.0]
    return float(np.median(noisy)) if noisy.size else 0.0


def squared_slope(halves: list[np.ndarray]) -> float:
    """Return the sum of squared differences of neighbouring pixels of the mean image, averaged over both directions. It is unbiased by
    noise, since it uses two independent halves (B, H, W, 3)."""
    one, other = (half.mean(axis=0, dtype=np.float64) for half in halves)
    return 0.5 * sum(float((np.diff(one, axis=axis) * np.diff(other, axis=axis)).sum()) for axis in (0, 1))


def differences(images: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """Return derivative images (m, H, W, 3) from images (2 m, H, W, 3), first those of increased, then those of decreased parameters.

    Args:
        images: the images.
        distances: distance of the two parameters of each difference, (m,); an element with 0 has no derivative.
    """
    over = np.divide(1.0, distances, out=np.zeros(distances.size), where=distances != 0.0)
    return ((images[: over.size].astype(np.float64) - images[over.size :]) * over[:, None, None, None]).astype(
        np.float32
    )


def products(halves: list[np.ndarray], weights: LossWeights | None, block: int = 1) -> Products:
    """Return the products of two independent halves of J, (m, H, W, 3) each.

    Args:
        halves: derivative images.
        weights: derivatives of the loss; None if only `squares` is needed.
        block: side of the blocks of pixels over which all but `squares` are summed.
    """
    m = len(halves[0])
    hessian, noise, gradient_noise, scores_of = (np.zeros((m, m)) for _ in range(4))
    total = Products(np.zeros(m), hessian, noise, gradient_noise, scores_of, np.zeros(m))
    for rows in _rows(halves[0], max(block, 1)):
        one, other = (half[:, rows].astype(np.float64) for half in halves)
        total.squares += (one * other).sum(axis=(1, 2, 3))
        if weights is None:
            continue
        first, second, at_one, at_other = (
            x[rows].astype(np.float64) for x in (weights.first, weights.second, weights.one, weights.other)
        )
        if block > 1:
            one, other, first, at_one, at_other = (_pooled(x, block) for x in (one, other, first, at_one, at_other))
            flat = second.reshape(*second.shape[:2], -1)
            second = (_pooled(flat, block) / _pooled(np.ones_like(flat), block)).reshape(
                *first.shape[:2], *second.shape[2:]
            )
        of_halves = [(part * at).sum(axis=3) for part, at in ((one, at_one), (other, at_other))]
        total.scores += scores.covariance(of_halves[0], of_halves[1])
        half = 0.5 * (of_halves[0] - of_halves[1]).reshape(m, -1)
        total.gradient_noise += half @ half.T
        noise_of_halves = 0.5 * (one - other)
        total.gradient += 0.5 * ((one + other).reshape(m, -1) @ first.reshape(-1))
        total.hessian += _times(one, second) @ other.reshape(m, -1).T
        total.noise += _times(noise_of_halves, second) @ noise_of_halves.reshape(m, -1).T
    total.hessian = 0.5 * (total.hessian + total.hessian.T)
    return total


def _times(images: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return derivative images times ℓ'', (m, values)."""
    mixed = second.ndim == images.ndim
    return (np.einsum("mhwc,hwcd->mhwd", images, second) if mixed else images * second).reshape(len(images), -1)


def _pooled(images: np.ndarray, block: int) -> np.ndarray:
    """Return sums over blocks of pixels, divided by the square root of their size, of images (..., H, W, 3)."""
    for axis in (-3, -2):
        starts = np.arange(0, images.shape[axis], block)
        sizes = np.diff(np.append(starts, images.shape[axis]))
        shape = [1] * images.ndim
        shape[axis] = -1
        images = np.add.reduceat(images, starts, axis=axis) / np.sqrt(sizes).reshape(shape)
    return images


def _rows(images: np.ndarray, block: int) -> Iterator[slice]:
    """Yield slices of full blocks of rows, with at most `_VALUES` values of all images if possible."""
    height = images.shape[1]
    step = max(_VALUES // max(images[:, :1].size * block, 1), 1) * block
    for start in range(0, height, step):
        yield slice(start, start + step)
