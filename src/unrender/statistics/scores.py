"""Covariance of a sum of pixel scores whose noise channels and neighbouring pixels share."""

from __future__ import annotations

import numpy as np

_FEWEST_PIXELS = 256
"""Number of pixels below which neighbours count as independent: their sums would cover too much of the image."""


def covariance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return an estimate of the covariance of Σ_p s_p over the pixels p of a picture, (n, n).

    The scores s_p are derivative times residual, summed over the channels, so channels may share their noise. Products with the eight
    neighbours are included, because wide film filters make their noise correlated. Pictures of fewer than 256 pixels leave these out.

    Args:
        one, other: (n, H, W), two estimates of the scores with independent rendering noise, which then adds no bias. Equal arrays
            include it.
    """
    from scipy.ndimage import uniform_filter1d  # takes long to import

    around = other
    if one[0].size >= _FEWEST_PIXELS:
        for axis in (1, 2):
            around = 3.0 * uniform_filter1d(around, 3, axis=axis, mode="constant")
    product = one.reshape(len(one), -1) @ around.reshape(len(one), -1).T
    return 0.5 * (product + product.T)


def positive_part(matrix: np.ndarray) -> np.ndarray:
    """Return the symmetric matrix with its negative eigenvalues set to 0, after scaling to unit diagonal."""
    units = np.sqrt(np.abs(np.diag(matrix)))
    units = np.where(units > 0.0, units, 1.0)
    eigenvalues, vectors = np.linalg.eigh(matrix / np.outer(units, units))
    return (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T * np.outer(units, units)
