"""Keeping parameters inside their bounds without stalling the descent."""

from __future__ import annotations

from unrender.core import arrays
from unrender.core.arrays import Array

MARGIN = 1e-4
"""Parameters stop this share of their range before a bound (of 1 where the range is open). At a reflectance of exactly 0 no
light arrives through a surface and its gradient is 0 for ever; a lobe of probability exactly 0 is never sampled again."""


def project(x: Array, low: float | None, high: float | None) -> Array:
    """The nearest point inside the bounds, less the margin. A projection, not a sigmoid: the gradient inside is untouched."""
    margin = MARGIN * (high - low if low is not None and high is not None else 1.0)
    if low is not None:
        x = arrays.maximum(x, low + margin)
    if high is not None:
        x = arrays.minimum(x, high - margin)
    return x
