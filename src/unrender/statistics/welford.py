"""Exponentially weighted running covariance in one pass (after Nicolet et al. 2023, Appendix A).

What is computed. Let m_k be the exponentially weighted mean of x_1 … x_k, weights a_{k,j} ∝ α^{k−j} that sum to one,
likewise for y. Each sample from the second on leaves an innovation, its distance to the mean of the samples before
it, and

    cov_n = Σ_{k=2..n} b_k (x_k − m^x_{k−1}) (y_k − m^y_{k−1}) / (1 + s_{k−1}),     s_k = Σ_j a_{k,j}²,

with weights b_k ∝ β^{n−k} that sum to one. An innovation holds the noise of the sample and of the mean, which are
independent: its expected product is Cov[x, y] (1 + s). So for independent, identically distributed pairs cov_n is
**unbiased from the second sample on**, whatever α and β.

How it differs from the paper's listing 2. The listing multiplies x_n − m^x_n (the mean with the sample) by y_n −
m^y_{n−1} (the mean without it) and debiases the two means at n and n − 1. As x_n − m_n = α (1−α^{n−1})/(1−α^n) · (x_n
− m_{n−1}), that product has the expectation 2α/(1+α) · Cov for every n >= 2, 5 % too little at α = 0.9. Its first
sample has no mean before it, contributes 0/0 or at best 0, yet is counted by the divisor 1 − β^n: another factor
(1−β^{n−1})/(1−β^n), one half at n = 2. Both factors are removed here. They are common to the variances and the
covariance of a pair, so control weights are the listing's own, but the statistic is a covariance at every step.

Drift. Identically distributed is what an optimisation's images are not: the mean lags 1/(1−α) steps behind. Means
that move by δx and δy a step add δx δy (1+α) / (2 (1−α)²) to the covariance, 95 δx δy at α = 0.9. Two states of one
scene drift alike, so Var F, Var H and Cov are raised by the same amount. The recursion stays as unbiased as it was, but
its weight grows too large once the drift of a step exceeds about a tenth of the standard deviation, up to an image
noisier than a plain one. A smaller α follows faster (α = 0.5 adds 3 δx δy) and costs little: noise of the mean is
divided out on average, and β decides how many innovations count.
"""

from __future__ import annotations

from dataclasses import dataclass

from unrender.core import arrays
from unrender.core.arrays import Array

__all__ = ["State", "covariance", "init", "update"]


@dataclass(frozen=True)
class State:
    """Running statistics of a stream of pairs (x, y).

    The three weights are device numbers, not Python's: they change from step to step and must not become literals of
    a kernel.

    Attributes:
        mean_x: weighted mean of x so far, its shape.
        mean_y: of y.
        moment: sum of the weighted innovation products, not yet divided by `moment_weight`.
        mean_weight: 1 − α^n after n samples.
        mean_weight_squares: sum of the squares of the weights that `mean_weight` sums.
        moment_weight: 1 − β^(n−1).
    """

    mean_x: Array
    mean_y: Array
    moment: Array
    mean_weight: Array
    mean_weight_squares: Array
    moment_weight: Array


def init(like: Array) -> State:
    """Before the first sample. `like` gives shape and type of the samples."""
    zeros, zero = arrays.zeros_like(like) * 1.0, arrays.scalar(0.0, like)
    return State(zeros, zeros, zeros, zero, zero, zero)


def update(
    state: State, x: Array, y: Array, alpha: float = 0.9, beta: float = 0.999, count: Array | float = 1.0
) -> State:
    """The state after one more pair.

    Args:
        state: from `init` or `update`.
        x, y: one sample each, of the shape given to `init`; the same array twice gives a variance.
        alpha: decay of the means, in [0, 1).
        beta: decay of the covariance, in [0, 1).
        count: of how many samples each is the mean, where the covariance of a single one is wanted; exact where it stays the same.
    """
    seen = state.mean_weight > 0
    inflation = 1.0 + state.mean_weight_squares / arrays.where(seen, state.mean_weight * state.mean_weight, 1.0)
    gain = arrays.where(seen, (1.0 - beta) / inflation, 0.0)
    dx, dy = x - state.mean_x, y - state.mean_y
    mean_weight = alpha * state.mean_weight + (1.0 - alpha)
    step = (1.0 - alpha) / mean_weight
    return State(
        mean_x=state.mean_x + step * dx,
        mean_y=state.mean_y + step * dy,
        moment=beta * state.moment + gain * (dx * dy) * count,
        mean_weight=mean_weight,
        mean_weight_squares=alpha * alpha * state.mean_weight_squares + (1.0 - alpha) * (1.0 - alpha),
        moment_weight=beta * state.moment_weight + arrays.where(seen, 1.0 - beta, 0.0),
    )


def covariance(state: State) -> Array:
    """The covariance of x and y, per element; 0 before two samples.

    Unbiased for independent, identically distributed pairs; see the module for what drift adds. Never negative where
    x and y are the same, and at most the geometric mean of the two variances (equal α and β).
    """
    return state.moment / arrays.where(state.moment_weight > 0, state.moment_weight, 1.0)
