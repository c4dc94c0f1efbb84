"""Recursion of a control variate over the states of the scene: its step, its optimal weight, and its variance.

Nicolet et al. 2023, Eqs 6, 8 and 10.

F is the estimate for the current state and H the estimate for the previous state from the same samples. ⟨·⟩_CV denotes the recursion
⟨F_n⟩_CV = F + w (⟨F_{n-1}⟩_CV − H), where ⟨F_{n-1}⟩_CV is independent of F and H. All arguments are arrays of one shape, or numbers.
"""

from __future__ import annotations

from unrender.core import arrays
from unrender.core.arrays import Array

__all__ = ["advance", "control_variate_variance", "control_weight"]


def control_weight(cov: Array, var_previous: Array, var_cv: Array) -> Array:
    """Return the weight of least variance, w = Cov[F, H] / (Var[H] + Var[⟨F_{n-1}⟩_CV]), clamped to [0, 1] (Eq. 8).

    Returns 0 where the denominator is 0 or an argument is NaN, as before any statistics exist. A common factor of the three arguments
    cancels.

    Args:
        cov: Cov[F, H].
        var_previous: Var[H], >= 0.
        var_cv: Var[⟨F_{n-1}⟩_CV], >= 0.
    """
    total = var_previous + var_cv
    known = total > 0  # also false for NaN
    weight = arrays.where(known, cov, 0.0) / arrays.where(known, total, 1.0)
    return arrays.clip(arrays.where(weight == weight, weight, 0.0), 0.0, 1.0)


def control_variate_variance(w: Array, var_current: Array, var_previous: Array, cov: Array, var_cv: Array) -> Array:
    """Return Var[⟨F_n⟩_CV] = Var[F] + w² Var[H] − 2 w Cov[F, H] + w² Var[⟨F_{n-1}⟩_CV], clamped to >= 0 (Eq. 10).

    Exact for exact statistics and a weight that is independent of them. Estimates from different windows can make the sum negative.

    Args:
        w: weight in use, in [0, 1].
        var_current: Var[F].
        var_previous: Var[H].
        cov: Cov[F, H].
        var_cv: Var[⟨F_{n-1}⟩_CV].
    """
    return arrays.maximum(var_current + w * (w * (var_previous + var_cv) - 2.0 * cov), 0.0)


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
