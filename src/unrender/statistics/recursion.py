"""Recursion of a control variate over the states of the scene."""

from __future__ import annotations

from unrender.core import arrays
from unrender.core.arrays import Array

__all__ = ["advance"]


def advance(memory: Array, current: Array, previous: Array, weight: Array) -> Array:
    """Return M_n = F + w (M_{n-1} − H) (Eq. 6 of Nicolet et al. 2023).

    Unbiased for E[F] if E[M_{n-1}] = E[H] and `weight` is independent of all three. A weight that is estimated from earlier samples is
    slightly dependent on M_{n-1}.

    Args:
        memory: M_{n-1}, the estimate for the previous state. Elements that are not finite are reset to M_n = F.
        current: F, the estimate for the current state.
        previous: H, the estimate for the previous state from the samples of F.
        weight: w in [0, 1], an array or a number. A weight of 0 discards the past.
    """
    difference = memory - previous
    return current + weight * arrays.where(arrays.is_finite(difference), difference, 0.0)
