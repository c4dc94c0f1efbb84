"""Covariance of a sum of pixel scores with noise that is correlated between channels and between neighbouring pixels."""

from __future__ import annotations

import numpy as np

_MOST_LEVERAGE = 0.9  # largest leverage of a pixel; noise of the slopes may make it larger
_LEAST_LEVERAGE = 1e-3  # norm of the leverages of a pixel up to which its residual is left as it is
_LEAST_CURVATURE = 1e-3  # smallest eigenvalue of a Hessian, relative to the largest, along which pixels have leverage
_AGREE_ERRORS = 3.0  # standard errors from which on neighbours share their noise
_FEWEST_PIXELS = 256
"""Number of pixels below which neighbours count as independent: their sums would cover too much of the image."""


def covariance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return an estimate of the covariance (n, n) of Σ_p s_p over the pixels p of a picture, for n parameters.

    The scores s_p (n,) are derivative times residual, summed over the channels, so noise may be correlated between channels. Wide film
    filters correlate the noise of neighbours. If the scores show that, products with the eight neighbours are included. They are left out
    otherwise, because they are noisy, and in pictures of fewer than 256 pixels.

    Args:
        one, other: (n, H, W), two estimates of the scores with independent rendering noise, which then adds no bias. Equal arrays
            include it.
    """
    shared = one[0].size >= _FEWEST_PIXELS and _neighbours_agree(0.5 * (one + other))
    around = _with_neighbours(other) if shared else other
    product = one.reshape(len(one), -1) @ around.reshape(len(one), -1).T
    return 0.5 * (product + product.T)


def _neighbours_agree(values: np.ndarray) -> bool:
    """Return whether neighbours have more products of equal sign than independent noise, for one of n elements, (n, H, W).

    If the noise is independent, Σ_p s_p Σ_q s_q over the neighbours q has mean 0 and the variance 2 Σ_p s_p² Σ_q s_q².
    """
    squares = np.square(values)
    sums = (values * (_with_neighbours(values) - values)).sum(axis=(1, 2))
    variances = 2.0 * (squares * (_with_neighbours(squares) - squares)).sum(axis=(1, 2))
    return bool((sums > _AGREE_ERRORS * np.sqrt(np.maximum(variances, 0.0))).any())


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    from scipy.ndimage import uniform_filter1d  # takes long to import

    for axis in (1, 2):
        values = 3.0 * uniform_filter1d(values, 3, axis=axis, mode="constant")
    return values


def without_own_pixel(
    residuals: np.ndarray, one: np.ndarray, other: np.ndarray, inverse: np.ndarray, weights: np.ndarray | None = None
) -> np.ndarray:
    """Return the residuals that each pixel would have if the fit had left it out, (1 − h)⁻¹ r, (..., P, C).

    A fit follows the noise of its pixels, so its residuals r are smaller than the noise. h = J_p (JᵀJ)⁻¹ J_pᵀ (C, C) is the leverage of a
    pixel, with eigenvalues clamped to [0, 0.9] (Efron's jackknife; HC3 of MacKinnon and White 1985).
    Residuals of pixels whose h has a Frobenius norm of at most 0.001 are unchanged: such h are of most pixels of large pictures.

    Args:
        residuals: residuals of the fit, (..., P, C), times the weights if there are any.
        one, other: two estimates of J with independent noise, (n, P, C). Equal arrays include the noise in the leverages.
        inverse: (JᵀJ)⁻¹, with weights (JᵀWJ)⁻¹, (n, n).
        weights: diagonal of W, (P, C), >= 0; None for 1.
    """
    roots = np.ones(one.shape[1:]) if weights is None else np.sqrt(np.maximum(weights, 0.0))
    leverages = np.einsum("kpc,kpd->pcd", np.tensordot(inverse, one * roots, axes=1), other * roots)
    leverages = 0.5 * (leverages + leverages.swapaxes(1, 2))
    high = np.square(leverages).sum(axis=(1, 2)) > _LEAST_LEVERAGE**2
    values, vectors = np.linalg.eigh(leverages[high])
    left, units = 1.0 - np.clip(values, 0.0, _MOST_LEVERAGE), np.where(roots > 0.0, roots, 1.0)[high]
    along = np.einsum("pcd,...pc->...pd", vectors, residuals[..., high, :] / units)
    result = np.array(residuals, np.float64)
    result[..., high, :] = np.einsum("pcd,...pd->...pc", vectors, along / left) * units
    return result


def positive_inverse(matrix: np.ndarray, least: float = _LEAST_CURVATURE) -> np.ndarray:
    """Return the pseudo-inverse of a symmetric matrix scaled to unit diagonal; eigenvalues up to `least` of the largest are 0."""
    scales, eigenvalues, vectors = scaled_eigh(matrix)
    used = eigenvalues > least * eigenvalues[-1]
    inverse = np.divide(1.0, eigenvalues, out=np.zeros_like(eigenvalues), where=used)
    return (vectors * inverse) @ vectors.T / scales


def positive_part(matrix: np.ndarray) -> np.ndarray:
    """Return D P D for the symmetric matrix D M D, where D is diagonal, M has a unit diagonal, and P is M without negative eigenvalues."""
    scales, eigenvalues, vectors = scaled_eigh(matrix)
    return (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T * scales


def scaled_eigh(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the elements' scales, and eigenvalues and eigenvectors of a symmetric matrix over them, which has a unit diagonal."""
    units = np.sqrt(np.abs(np.diag(matrix)))
    units = np.where(units > 0.0, units, 1.0)
    scales = np.outer(units, units)
    eigenvalues, vectors = np.linalg.eigh(matrix / scales)
    return scales, eigenvalues, vectors
