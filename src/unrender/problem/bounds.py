"""Projection of parameters onto their bounds."""

from __future__ import annotations

from unrender.core import arrays
from unrender.core.arrays import Array

__all__ = ["MARGIN", "project"]

MARGIN = 1e-4
"""Distance from a bound at which parameters are clamped, as a fraction of their range (of 1 where it is open). At a reflectance of
exactly 0 no light arrives through a surface and its gradient is 0 for ever; a lobe of probability exactly 0 is never sampled again."""


def project(x: Array, low: float | None, high: float | None) -> Array:
    """The nearest point inside the bounds, less the margin. A projection, not a sigmoid: the gradient inside is untouched."""
    margin = MARGIN * (high - low if low is not None and high is not None else 1.0)
    if low is not None:
        x = arrays.maximum(x, low + margin)
    if high is not None:
        x = arrays.minimum(x, high - margin)
    return x
