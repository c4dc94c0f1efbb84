"""Exponentially weighted running covariance in one pass (after Nicolet et al. 2023, Appendix A).

Definition. Let m_k be the exponentially weighted mean of x_1 … x_k, with weights a_{k,j} ∝ α^{k−j} that sum to one, and m^y_k that of y.
Each sample from the second on has an innovation, its difference from the mean of the earlier samples. The covariance is

    cov_n = Σ_{k=2..n} b_k (x_k − m^x_{k−1}) (y_k − m^y_{k−1}) / (1 + s_{k−1}),     s_k = Σ_j a_{k,j}²,

with weights b_k ∝ β^{n−k} that sum to one. An innovation contains the independent noise of the sample and of the mean, so its expected
product is Cov[x, y] (1 + s). For independent, identically distributed pairs cov_n is therefore **unbiased from the second sample on**,
for every α and β.

Difference from the paper's listing 2. The listing multiplies x_n − m^x_n (the mean with the sample) by y_n − m^y_{n−1} (the mean without
it), and debiases the two means at n and n − 1. Because x_n − m_n = α (1−α^{n−1})/(1−α^n) · (x_n − m_{n−1}), that product has the
expectation 2α/(1+α) · Cov for every n >= 2, which is 5 % too small at α = 0.9. Its first sample has no earlier mean and contributes 0/0,
or 0, but the divisor 1 − β^n counts it. This gives another factor (1−β^{n−1})/(1−β^n), one half at n = 2. This module removes both
factors. Variances and covariance share them, so the control weights equal those of the listing, but here the statistic is a covariance at
every step.

Drift. The images of an optimisation are not identically distributed: the mean lags 1/(1−α) steps behind. Means that move by δx and δy per
step add δx δy (1+α) / (2 (1−α)²) to the covariance, 95 δx δy at α = 0.9. Two states of one scene drift equally, so Var F, Var H and Cov
increase by the same amount. The recursion stays unbiased, but its weight becomes too large once the drift per step exceeds about a tenth
of the standard deviation; the image can then be noisier than a plain one. A smaller α follows faster (α = 0.5 adds 3 δx δy) at little
cost: the division by 1 + s removes the noise of the mean on average, and β determines the number of innovations.
"""

from __future__ import annotations

from dataclasses import dataclass

from unrender.core import arrays
from unrender.core.arrays import Array

__all__ = ["State", "covariance", "init", "update"]


@dataclass(frozen=True)
class State:
    """Running statistics of a stream of pairs (x, y).

    The three weights change at every step. They are device numbers, because Python numbers would become literals of a kernel.

    Attributes:
        mean_x: weighted mean of x, with the shape of x.
        mean_y: weighted mean of y.
        moment: weighted sum of the innovation products, not yet divided by `moment_weight`.
        mean_weight: 1 − α^n after n samples.
        mean_weight_squares: sum of the squared weights whose sum is `mean_weight`.
        moment_weight: 1 − β^(n−1).
    """

    mean_x: Array
    mean_y: Array
    moment: Array
    mean_weight: Array
    mean_weight_squares: Array
    moment_weight: Array


def init(like: Array) -> State:
    """Return the state before the first sample; `like` has the shape and type of the samples."""
    zeros, zero = arrays.zeros_like(like) * 1.0, arrays.scalar(0.0, like)
    return State(zeros, zeros, zeros, zero, zero, zero)


def update(
    state: State, x: Array, y: Array, alpha: float = 0.9, beta: float = 0.999, count: Array | float = 1.0
) -> State:
    """Return the state after one more pair.

    Args:
        state: from `init` or `update`.
        x, y: one sample each, with the shape given to `init`; the same array twice gives a variance.
        alpha: decay of the means, in [0, 1).
        beta: decay of the covariance, in [0, 1).
        count: number of samples of which x and y are means, if the covariance of single samples is wanted. Exact for a constant count.
    """
    positive = state.mean_weight > 0
    inflation = 1.0 + state.mean_weight_squares / arrays.where(positive, state.mean_weight * state.mean_weight, 1.0)
    gain = arrays.where(positive, (1.0 - beta) / inflation, 0.0)
    dx, dy = x - state.mean_x, y - state.mean_y
    mean_weight = alpha * state.mean_weight + (1.0 - alpha)
    step = (1.0 - alpha) / mean_weight
    return State(
        mean_x=state.mean_x + step * dx,
        mean_y=state.mean_y + step * dy,
        moment=beta * state.moment + gain * (dx * dy) * count,
        mean_weight=mean_weight,
        mean_weight_squares=alpha * alpha * state.mean_weight_squares + (1.0 - alpha) * (1.0 - alpha),
        moment_weight=beta * state.moment_weight + arrays.where(positive, 1.0 - beta, 0.0),
    )


def covariance(state: State) -> Array:
    """Return the covariance of x and y per element; 0 before the second sample.

    Unbiased for independent, identically distributed pairs; the module describes the effect of drift. For equal x and y it is never
    negative. With equal α and β it is at most the geometric mean of the two variances.
    """
    return state.moment / arrays.where(state.moment_weight > 0, state.moment_weight, 1.0)
