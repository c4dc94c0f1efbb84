"""The recursion of control variates from one state of the scene to the next."""

from __future__ import annotations

from unrender.core import arrays
from unrender.core.arrays import Array

__all__ = ["advance"]


def advance(memory: Array, current: Array, previous: Array, weight: Array) -> Array:
    """M_n = F + w (M_{n-1} − H): Eq. 6 of Nicolet et al. 2023.

    Unbiased for E[F] where E[M_{n-1}] = E[H] and `weight` is independent of all three; a weight estimated from
    earlier samples is not quite independent of M_{n-1}.

    Args:
        memory: M_{n-1}, the estimate for the previous state. Elements that are not finite are reset: M_n = F there.
        current: F, the current state's estimate.
        previous: H, the previous state's estimate from the samples of F.
        weight: w in [0, 1]: with 0 the past has no influence. An array or a number.
    """
    difference = memory - previous
    return current + weight * arrays.where(arrays.is_finite(difference), difference, 0.0)
