"""Loss derivatives where an image's noise exceeds its distance from the reference."""

from __future__ import annotations

from unrender.core import arrays
from unrender.core.arrays import Array

__all__ = ["damping", "smoothed_variance"]

_SIDE = 9
"""Of the square of pixels that variances are averaged over, twice."""


def damping(residual: Array, variance: Array, tolerance: float) -> Array:
    """|r| / √(r² + κ² σ²): the derivative of |r| times this is that of Charbonnier's loss √(r² + δ²), with δ = κ σ.

    Args:
        residual: r, image minus reference, (..., H, W, 3).
        variance: σ² of the image, (H, W, 3).
        tolerance: κ, > 0.
    """
    square = residual * residual
    return arrays.sqrt(square / (square + (tolerance * tolerance) * variance + 1e-20))


def smoothed_variance(variance: Array) -> Array:
    """The mean of the variance (H, W, 3) over each pixel's neighbours: a pixel whose few samples agreed has not yet seen its fireflies.

    Waits for the device.
    """
    from scipy import ndimage

    values = arrays.numpy(variance)
    for _ in range(2):
        for axis in (0, 1):
            values = ndimage.uniform_filter1d(values, _SIDE, axis, mode="nearest")
    return arrays.like(values.clip(min=0.0), variance)
