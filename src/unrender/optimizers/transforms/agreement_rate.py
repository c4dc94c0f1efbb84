"""Learning rates that follow the cosine similarity of successive gradients."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.checks import NotNegative
from unrender.core.memory import inner_products
from unrender.core.registry import register
from unrender.core.text import listed
from unrender.core.trees import Tree
from unrender.estimators.capabilities import NoiseSample
from unrender.optimizers.transforms.base import (
    SMOOTHING_UNCHANGED,
    StepTransform,
    StepUpdate,
    TransformState,
    checked_keys,
)

_DELAY = 10.0
"""τ of the docstring, in steps."""
_EARLY = 160.0
"""T of the docstring, in steps."""
_STEEPEST = 0.6
"""Largest power of 1/t in the decay: between 1/2 and 1 for averaged iterates, as in Polyak and Juditsky 1992."""
_MEMORY = 0.8
"""Decay of the mean correlation of successive gradients."""
_PAIRS = (1 + _MEMORY) / (1 - _MEMORY)
"""Number of independent pairs of gradients with the same variance in a plain mean."""
_LASTING_ERRORS = 2.0
"""Standard errors 1/√n of the lasting fraction that are added to it before growth is taken back; share of the rate that other growth
leaves."""
FEWEST_ELEMENTS = 64
"""Number of elements from which the noise of a gradient is known to a fifth from one sample."""
_NOISE_IN_STEP, _MOST_FIRST = 1.0 / 6.0, 3.0
"""Root mean square of the noise in a longer first step, relative to the unchanged step, and largest factor of the first rate."""
_LONGER = 16.0
"""Number of steps with this factor. In later ones noise decides the error, which longer steps raise."""
_MOST_GROWTH = 3.0
"""Largest rate relative to the first one, and relative to the growth of the parameters."""
_FALL = 0.75
"""Ratio of successive rates below which the averaged iterate restarts."""
_INFLATION = 0.25
"""Power of the inflation by which rates fall. With 1/2, weakly observed elements recover too slowly from early noise."""
_REFINED = 0.3
"""Largest rate, relative to the first one, at a step that reduces smoothing."""


@dataclass(frozen=True)
class Agreement(TransformState):
    """State of `AgreementRate`.

    Attributes:
        correlation: {key: ρ, the mean correlation of successive gradients}.
        log_rate: {key: logarithm of the factor of the rate without the inflation of the noise}.
        log_most: {key: the same, if all agreement lasts}.
        log_least: {key: the same, as if gradients had not agreed since the last change of smoothing}.
        factors: {key: factor of the rate}.
        sizes: {key: root mean square of the first parameters, 1 where that is 0, and at least the first rate}.
        firsts: {key: factor of the first rate}; 1 for keys that it lacks, as before the first step.
    """

    correlation: dict[str, float]
    log_rate: dict[str, float]
    log_most: dict[str, float]
    log_least: dict[str, float]
    factors: dict[str, float]
    sizes: dict[str, float]
    firsts: dict[str, float] = field(default_factory=dict)

    def first_factors(self, made: int) -> dict[str, float]:
        """Return {key: what is left of the factor of the first rate after some steps}."""
        power = min(1.0, _LONGER / max(made, 1))
        return {key: self.firsts.get(key, 1.0) ** power for key in self.factors}


@register
@dataclass(frozen=True)
class AgreementRate(StepTransform):
    """Adapt each parameter's learning rate to the mean correlation ρ of its successive gradients.

        log η_{t+1} = log η_t + q_t max(0, 2 (ρ − s_ρ) − 1) − 2 q max(0, −ρ − s) − min(p (1 − max(0, ρ)), 0.6) / (t + τ)

    with q_t = q min(1, T / t), T = 160 and τ = 10. The rate grows while gradients agree, shrinks where they oppose each other, as after too
    long steps, and decays as t^-0.6 once they are noise. After T steps it grows at most as a power of t. ρ is multiplied by the fraction
    of the agreement that is not reused noise (`SmoothingChange.confirmed` and `lasting`). s = 1/(3 √n) is the standard error of ρ for
    random gradients of n elements, and s_ρ = s max(1 − ρ², 0.8^t) that of correlated ones; 0.8^t is the weight of the initial ρ = 1.

    Agreement that does not last comes from steps back and forth around the minimum, and what it added to the rate is taken back: the factor
    of the rate is f η + (1 − f) η', where f is the lasting fraction plus two standard errors, 2/√n, and η' follows the same rule with
    min(ρ, 0) in place of ρ since the last change of smoothing. Directions that no pixel determines would otherwise follow a random walk
    with long steps. The rate is also multiplied by f + (1 − f) I^(-1/4) for the inflation I of the noise (`SmoothingChange.inflation`),
    since gradients are scaled by the noise of single steps, and reused noise adds up. `SmoothingChange.growth` multiplies it where a signal
    lasts that noise hides from successive gradients, less for few elements, whose agreement is uncertain.

    Where the rate falls by more than a quarter from one step to the next, the averaged iterate restarts. With shorter steps it would keep
    the displacement that noise has given it with the longer ones, and the average would move there.

    The first rate is multiplied by min(3, max(1, 1 / (6 √ν))), where ν is the squared length of the noise in the first gradient
    relative to that of the gradient, from a `NoiseSample`. Without noise a long step ends nearer to the solution, with noise further
    from it. After 16 steps the factor has the power 16 / t. It is 1 for fewer than 64 elements, from which ν is uncertain, and after
    a step that reduces smoothing.

    The rate is at most 3 times the first, times the growth of the parameter. At a step that reduces smoothing it is at most 0.3 times the
    first. Needs a `FittedSobolev` before it, which stores the last gradient.

    Args:
        growth: q, >= 0; 0 for a rate that never grows.
        decay: p, >= 0; 0 for a rate that never decays.
        unsized: Keys of parameters whose growth does not raise the limit, such as those optimised as logarithms.
    """

    growth: NotNegative = 0.1
    decay: NotNegative = 1.5
    unsized: tuple[str, ...] = ()

    def __post_init__(self):
        checks.fields(self)
        object.__setattr__(self, "unsized", checked_keys("AgreementRate: unsized", self.unsized))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> Agreement:
        sizes = {
            key: max(_root_mean_square(x, arrays.number(arrays.total(x * x))) or 1.0, learning_rates[key])
            for key, x in parameters.items()
        }
        zeros, ones = dict.fromkeys(parameters, 0.0), dict.fromkeys(parameters, 1.0)
        return Agreement(ones, zeros, zeros, zeros, ones, sizes)

    def update(self, update: StepUpdate, state: Agreement) -> tuple[StepUpdate, Agreement]:
        """Adapt the learning rates. Waits for the device, because correlations and sizes of the parameters are read."""
        previous = update.require_previous("AgreementRate")
        if update.made == 0:
            noise = update.estimate.get(NoiseSample)
            factors = {} if noise is None else _first_factors(update, noise.values)
            state = replace(state, firsts=dict.fromkeys(state.factors, 1.0) | factors)
        if update.made > 0:
            correlation, log_rate, log_most, log_least, factors = {}, {}, {}, {}, {}
            for key, (cosine, size) in _measured(update.gradient, previous, update.parameters).items():
                rho = correlation[key] = _MEMORY * state.correlation[key] + (1.0 - _MEMORY) * cosine
                fit, shape = update.smoothing.get(key, SMOOTHING_UNCHANGED), arrays.shape(update.gradient[key])
                grown = 1.0 if key in self.unsized else max(1.0, size / state.sizes[key])
                limit = math.log(_MOST_GROWTH * grown if fit.gain == 1.0 else _REFINED if fit.gain > 1.0 else 1.0)
                change = self._change(min(rho, rho * min(fit.confirmed, fit.lasting)), shape, update.made)
                before = state.log_most if fit.gain == 1.0 else state.log_rate
                most = log_most[key] = min(before[key] + change, limit)
                least = state.log_least[key] + self._change(min(rho, 0.0), shape, update.made)
                least = log_least[key] = min(least, most) if fit.gain == 1.0 else most
                errors = _LASTING_ERRORS / math.sqrt(max(1, math.prod(shape)))
                share, few = min(1.0, fit.lasting + errors), min(1.0, errors)
                log_rate[key] = math.log((1.0 - share) * math.exp(least) + share * math.exp(most))
                factor = math.exp(log_rate[key]) * (share + (1.0 - share) * fit.inflation**-_INFLATION)
                factors[key] = max(factor, min(factor * (few + (1.0 - few) * fit.growth), math.exp(limit)))
            falls = {key for key, q in factors.items() if q < _FALL * state.factors[key]}
            falls = {key for key in falls if update.smoothing.get(key, SMOOTHING_UNCHANGED).gain == 1.0}
            update = replace(update, restarted=update.restarted | falls)
            weaker = {key for key, fit in update.smoothing.items() if fit.gain > 1.0}
            firsts = {key: 1.0 if key in weaker else first for key, first in state.firsts.items()}
            state = Agreement(correlation, log_rate, log_most, log_least, factors, state.sizes, firsts)
        firsts = state.first_factors(update.made)
        factors = {key: update.factors.get(key, 1.0) * q * firsts[key] for key, q in state.factors.items()}
        return replace(update, factors=factors), state

    def choices(self, state: Agreement, made: int) -> tuple[str, ...]:
        """Return the current rates relative to the first."""
        firsts = state.first_factors(made)
        changed = [f"{key} {q * firsts[key]:.2g}" for key, q in state.factors.items()] if made > 0 else []
        return (f"learning rate, over the first: {listed(changed)}",) if changed else ()

    def _change(self, correlation: float, shape: tuple[int, ...], made: int) -> float:
        """Return the change of the rate's logarithm in one step."""
        power = min(self.decay * (1.0 - max(0.0, correlation)), _STEEPEST)
        error = 1.0 / math.sqrt(_PAIRS * max(1, math.prod(shape)))
        agreement = correlation - error * max(1.0 - correlation**2, _MEMORY**made)
        rise = max(0.0, 2.0 * agreement - 1.0) * min(1.0, _EARLY / made)
        change = self.growth * (rise - 2.0 * max(0.0, -correlation - error))
        return change - power / (made + _DELAY)


def _first_factors(update: StepUpdate, noise: Tree) -> dict[str, float]:
    """Return {key: factor of the first rate} from a sample of the first gradient's noise."""
    factors = {}
    for key, sample in noise.items():
        change, g = update.smoothing.get(key, SMOOTHING_UNCHANGED), update.gradient[key]
        smooth = sample if change.preconditioner is None else change.preconditioner.apply(sample)
        signal, part = (arrays.number(square) for square in inner_products([(g, g), (smooth, smooth)]))
        if math.prod(arrays.shape(g)) >= FEWEST_ELEMENTS and signal > 0.0:
            factors[key] = min(_MOST_FIRST, max(1.0, _NOISE_IN_STEP * math.sqrt(signal / max(part, 1e-9 * signal))))
    return factors


def _root_mean_square(x: Array, square: float) -> float:
    """Return the root mean square of an array from the sum of its squares; 0 for an empty array."""
    return math.sqrt(square / max(1, math.prod(arrays.shape(x))))


def _measured(gradient: Tree, previous: Tree, parameters: Tree) -> dict[str, tuple[float, float]]:
    """Return {key: (cosine of the angle between two gradients, 0 if one of them is 0; root mean square of the parameter)}."""
    sums = {
        key: inner_products([(g, previous[key]), (g, g), (previous[key],) * 2, (parameters[key],) * 2])
        for key, g in gradient.items()
    }
    arrays.evaluate(sums)
    measured = {}
    for key, parts in sums.items():
        product, one, other, square = (arrays.number(part) for part in parts)
        lengths = math.sqrt(one) * math.sqrt(other)
        measured[key] = (product / lengths if lengths > 0 else 0.0, _root_mean_square(parameters[key], square))
    return measured
