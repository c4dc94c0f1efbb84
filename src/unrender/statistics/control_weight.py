"""The optimal weight of a control variate, and the variance of the result (Nicolet et al. 2023, Eqs 8 and 10).

F is the current state's estimate, H the previous state's from the same samples, and ⟨·⟩_CV the recursion
⟨F_n⟩_CV = F + w (⟨F_{n-1}⟩_CV − H). ⟨F_{n-1}⟩_CV is independent of F and H. All arguments are arrays of one shape, or
numbers.
"""

from __future__ import annotations

from unrender.core import arrays
from unrender.core.arrays import Array


def control_weight(cov: Array, var_previous: Array, var_cv: Array) -> Array:
    """w = Cov[F, H] / (Var[H] + Var[⟨F_{n-1}⟩_CV]), clamped to [0, 1]: Eq. 8, the w of least variance.

    0 before there are statistics: where the denominator is 0, or anything is NaN. The three may be scaled by one
    common factor.

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
    """Var[⟨F_n⟩_CV] = Var[F] + w² Var[H] − 2 w Cov[F, H] + w² Var[⟨F_{n-1}⟩_CV], never negative: Eq. 10.

    Exact for exact statistics and a weight independent of them. With estimates from different windows the sum can fall
    below 0, and is clamped.

    Args:
        w: the weight that was used, in [0, 1].
        var_current: Var[F].
        var_previous: Var[H].
        cov: Cov[F, H].
        var_cv: Var[⟨F_{n-1}⟩_CV].
    """
    return arrays.maximum(var_current + w * (w * (var_previous + var_cv) - 2.0 * cov), 0.0)
