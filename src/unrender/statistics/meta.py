"""Meta-estimation: a recursive gradient estimate with its own variance (Balint et al. 2023, sections 3 and 4).

F_i is a *proportional* estimate of the quantity at step i. ΔF_i is a *finite-difference* estimate of its change since step i − 1,
independent of F_i. The meta-estimate combines both with the previous meta-estimate at least variance,

    M_i = α_i (M_{i-1} + ΔF_i) + (1 − α_i) F_i,        M_0 = F_0                              (Eq. 7)
    α_i = Var F / (Var F + Var M_{i-1} + Var ΔF)                                              (Eq. 8)
    Var M_i = α_i² (Var M_{i-1} + Var ΔF) + (1 − α_i)² Var F                                  (Eq. 15)

Var F is the running mean of F² (Eq. 9). Var ΔF is the running mean of (ΔF / ‖Δπ‖)² times ‖Δπ‖² of the current step (Eqs 13 and 14). α_i
is at most 1 / (2 − α_{i-1}) (Eq. 17), which from α_0 = 0 equals the bound i / (i + 1) of Eq. 16.

The *coupled* form is not in the paper. It takes F_i and the estimate H_i of the previous state from the same samples, so ΔF_i = F_i − H_i
is not independent of F_i. Its recursion M_i = F_i + w_i (M_{i-1} − H_i) equals Eq. 7 with H = F − ΔF. Its weight and variance are those
of a control variate (`recursion.py`) with Cov[F, H] = Var F − Var[F − H] / 2, where Var H is approximated by Var F.

Deviations from the paper:

- The running means are divided by the sum of their weights, as in Adam. Eqs 9 and 13 do not define their start.
- An element whose samples have all been zero, such as a texel that no path has hit, counts these zeros: α is at its bound, and M has the
  variance Var F / i at the first non-zero sample after i zeros. A weight of 0 would restart from that sample, which is i times too large.
- M can be non-zero although every observed sample of F was zero: a difference was non-zero first, or the summed samples were non-zero
  before the observed ones. Var M is then at least M² / n after n steps, not 0.

Bias. Var F is updated before use, so α depends on F_i and ΔF_i, and large samples get smaller weights. The bias toward zero is strongest
at the start and never vanishes, because the current sample has the weight 1 − β_F in Var F (section 6 of the paper, "sample reuse"). With
statistics from other samples (`observed`), and parameters that do not depend on the samples, every M_i is unbiased.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.statistics.recursion import advance, control_variate_variance, control_weight

__all__ = [
    "BETA_DIFFERENCE",
    "BETA_PROPORTIONAL",
    "Moments",
    "State",
    "clip_alpha",
    "init",
    "meta_variance",
    "optimal_alpha",
    "update",
    "update_coupled",
]

BETA_PROPORTIONAL = 0.99
"""β_F: large, because Var F is stable and should hardly depend on one sample."""

BETA_DIFFERENCE = 0.9
"""β_Δ: small, because the decoupled variance of ΔF has little noise and follows changes of the scene."""


@dataclass(frozen=True)
class Moments:
    """Exponentially weighted sums of a sample and of its square, and the sum of the weights, 1 − βⁿ (a device number).

    `mean` is the number 0 if variances are not centred.
    """

    mean: Array
    square: Array
    weight: Array


@dataclass(frozen=True)
class State:
    """State between steps.

    Arrays have the shape of the samples. `steps`, the weights of the moments and unused means are numbers.

    Attributes:
        gradient: M.
        variance: Var M.
        alpha: the last α.
        proportional: moments of F.
        difference: moments of ΔF / ‖Δπ‖.
        steps: number of steps so far (a device number).
    """

    gradient: Array
    variance: Array
    alpha: Array
    proportional: Moments
    difference: Moments
    steps: Array


def init(like: Array) -> State:
    """Return the state before the first sample; `like` has the shape and type of the samples."""
    zeros, zero = arrays.zeros_like(like) * 1.0, arrays.scalar(0.0, like)
    empty = Moments(zero, zeros, zero)
    return State(zeros, zeros, zeros, empty, empty, zero)


def update(
    state: State,
    proportional: Array,
    difference: Array,
    step_norm: Array,
    *,
    beta_proportional: float = BETA_PROPORTIONAL,
    beta_difference: float = BETA_DIFFERENCE,
    clip: bool = True,
    max_weight: float = 1.0,
    centred: bool = False,
    decouple: bool = True,
    observed: tuple[Array, Array] | None = None,
) -> tuple[Array, Array, Array, State]:
    """Perform one step of the paper's form, with independent F and ΔF.

    Args:
        state: from `init` or `update`.
        proportional: F_i.
        difference: ΔF_i = F_i − F_{i-1}; ignored at the first step.
        step_norm: ‖π_i − π_{i-1}‖₂ over all parameters, a number or a device number. The statistics of ΔF are not updated where it is 0.
        beta_proportional: β_F of Eq. 9, in [0, 1).
        beta_difference: β_Δ of Eq. 13, in [0, 1).
        clip: whether Eq. 17 bounds α.
        max_weight: upper bound of α, in (0, 1]; 1 in the paper. A smaller bound forgets an error after about 1 / (1 − max_weight) steps.
        centred: whether variances are about the mean, instead of mean squares. For comparison with Fig. 5: unreliable.
        decouple: whether differences are divided by the step before averaging (Eq. 13). For comparison.
        observed: (F, ΔF) from which variances are estimated in place of the summed ones. Independent samples make M unbiased.

    Returns:
        (M_i, Var M_i, α_i, the next state).
    """
    statistics = observed or (proportional, difference)
    state, var_f, var_d, var_m, started = _observe(
        state, *statistics, step_norm, beta_proportional, beta_difference, centred, decouple
    )
    alpha = _bounded_alpha(state, optimal_alpha(var_f, var_m, var_d), var_f, started, clip, max_weight)
    gradient = advance(state.gradient, proportional, proportional - difference, alpha)
    return _next(state, gradient, meta_variance(alpha, var_f, var_m, var_d), alpha, var_f)


def update_coupled(
    state: State,
    current: Array,
    previous: Array,
    step_norm: Array,
    *,
    beta_proportional: float = BETA_PROPORTIONAL,
    beta_difference: float = BETA_DIFFERENCE,
    clip: bool = True,
    max_weight: float = 1.0,
    centred: bool = False,
    decouple: bool = True,
    observed: tuple[Array, Array] | None = None,
) -> tuple[Array, Array, Array, State]:
    """Perform one step of the coupled form, where both states share all samples.

    Args:
        current: F_i.
        previous: H_i, the estimate for step i − 1 from the samples of F_i; ignored at the first step.
        observed: (F, H) from which variances are estimated in place of the summed ones.

    The other arguments and the result are those of `update`.
    """
    F, H = observed or (current, previous)
    state, var_f, var_d, var_m, started = _observe(
        state, F, F - H, step_norm, beta_proportional, beta_difference, centred, decouple
    )
    cov = arrays.maximum(var_f - 0.5 * var_d, 0.0)
    alpha = _bounded_alpha(state, control_weight(cov, var_f, var_m), var_f, started, clip, max_weight)
    gradient = advance(state.gradient, current, previous, alpha)
    return _next(state, gradient, control_variate_variance(alpha, var_f, var_f, cov, var_m), alpha, var_f)


def optimal_alpha(var_proportional: Array, var_memory: Array, var_difference: Array) -> Array:
    """Return the weight of the past with least variance, in [0, 1]; 0 where all three variances are 0 (Eq. 8)."""
    total = var_proportional + var_memory + var_difference
    return arrays.where(total > 0, var_proportional, 0.0) / arrays.where(total > 0, total, 1.0)


def clip_alpha(alpha: Array, before: Array) -> Array:
    """Bound α by 1 / (2 − α_{i-1}), the weight of the past in an average of equal samples (Eq. 17)."""
    return arrays.minimum(alpha, 1.0 / (2.0 - before))


def meta_variance(alpha: Array, var_proportional: Array, var_memory: Array, var_difference: Array) -> Array:
    """Return the variance of M for independent F and ΔF, and a weight that is independent of them (Eq. 15)."""
    rest = 1.0 - alpha
    return alpha * alpha * (var_memory + var_difference) + rest * rest * var_proportional


def _observe(
    state: State,
    F: Array,
    difference: Array,
    step_norm: Array,
    beta_proportional: float,
    beta_difference: float,
    centred: bool,
    decouple: bool,
) -> tuple[State, Array, Array, Array, Array]:
    """Update the statistics of F and ΔF.

    Returns:
        (state, Var F, Var ΔF, Var M of the last step, 1 if there was a last step else 0).
    """
    if isinstance(step_norm, (int, float)):
        step_norm = arrays.scalar(float(step_norm), F)
    only_zeros = state.proportional.square == 0.0
    # Two masks: the first step has no difference, and a step of length 0 carries no information about it.
    started = arrays.where(state.steps > 0.0, 1.0, 0.0)
    changed = started * arrays.where(step_norm > 0.0, 1.0, 0.0)
    unit = arrays.where(step_norm > 0.0, step_norm, 1.0) if decouple else step_norm * 0.0 + 1.0
    past = arrays.maximum(state.steps, 1.0)
    gain_f, gain_d = changed * 0.0 + (1.0 - beta_proportional), changed * (1.0 - beta_difference)
    weight_f = (1.0 - gain_f) * state.proportional.weight + gain_f
    weight_d = (1.0 - gain_d) * state.difference.weight + gain_d
    scale_f = 1.0 / weight_f
    scale_d = arrays.where(weight_d > 0.0, 1.0, 0.0) / arrays.where(weight_d > 0.0, weight_d, 1.0)
    length = step_norm * step_norm if decouple else changed * 1.0
    # Numbers must be evaluated before they are combined with arrays: Dr.Jit resizes an unevaluated number in place to the array's size.
    arrays.evaluate(started, unit, past, gain_f, gain_d, weight_f, weight_d, scale_f, scale_d, length)
    proportional = _average(state.proportional, F, gain_f, weight_f, centred)
    changes = _average(state.difference, difference / unit, gain_d, weight_d, centred)
    var_f = _variance(proportional, scale_f, centred)
    var_d = _variance(changes, scale_d, centred) * length
    var_m = arrays.where(only_zeros, arrays.maximum(var_f / past, state.variance), state.variance)
    return replace(state, proportional=proportional, difference=changes), var_f, var_d, var_m, started


def _average(moments: Moments, sample: Array, gain: Array, weight: Array, centred: bool) -> Moments:
    """Return the moments with one more sample; unchanged where `gain` is 0."""
    return Moments(
        moments.mean + gain * (sample - moments.mean) if centred else moments.mean,
        moments.square + gain * (sample * sample - moments.square),
        weight,
    )


def _variance(moments: Moments, scale: Array, centred: bool) -> Array:
    square, mean = moments.square * scale, moments.mean * scale
    if not centred:
        return square
    about = square - mean * mean
    # a smaller value is rounding error of equal samples in single precision
    return arrays.where(about > 1e-4 * square, about, 0.0)


def _bounded_alpha(state: State, alpha: Array, var_f: Array, started: Array, clip: bool, max_weight: float) -> Array:
    """Return α: 0 at the first step, else at most `max_weight` and, where all samples were zero or with `clip`, the bound of Eq. 17."""
    bound = clip_alpha(var_f * 0.0 + 1.0, state.alpha)
    alpha = arrays.where(var_f > 0.0, alpha, bound)
    return arrays.minimum(arrays.minimum(alpha, bound) if clip else alpha, max_weight) * started


def _next(
    state: State, gradient: Array, variance: Array, alpha: Array, var_f: Array
) -> tuple[Array, Array, Array, State]:
    steps = state.steps + 1.0
    arrays.evaluate(steps)
    floor = gradient * gradient / steps
    variance = arrays.where(var_f > 0.0, variance, arrays.maximum(variance, floor))
    next_state = replace(state, gradient=gradient, variance=variance, alpha=alpha, steps=steps)
    return gradient, variance, alpha, next_state
