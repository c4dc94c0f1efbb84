"""Schedule-free Adam (Defazio et al. 2024, "The Road Less Scheduled"), with a rate that falls as far as gradients are noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import cast

from unrender.core import arrays, checks, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import listed
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, FreshGradient, Gradient
from unrender.optimizers import rates
from unrender.optimizers.agreement import measured, root_mean_square
from unrender.optimizers.signal_share import signal_share
from unrender.optimizers.strength import StrengthFit
from unrender.preconditioners import Sobolev
from unrender.preconditioners.base import MeshPreconditioner, PeriodicPreconditioner, Preconditioner
from unrender.preconditioners.mesh import MeshTopology
from unrender.problem.coarse_to_fine import checked_steps
from unrender.problem.upsampling import SQUARES, Upsampler
from unrender.schedules.functions import Schedule

__all__ = ["ScheduleFree", "ScheduleFreeState"]

_WARMUP = 2
"""Steps over which the rate rises."""
_DELAY = 10.0
"""τ of the docstring, in steps."""
_STEEPEST = 0.6
"""The greatest power of 1/t that the rate falls by: between 1/2 and 1, with averages, as in Polyak and Juditsky 1992."""
_MEMORY = 0.8
"""Decay of the mean correlation of successive gradients."""
_PAIRS = (1 + _MEMORY) / (1 - _MEMORY)
"""Independent pairs of gradients of which a plain mean would tell as much."""
_MOST_GROWTH = 3.0
"""Times the first rate, and times what the parameters themselves have grown by."""
_REFINED = 0.3
"""The greatest rate, over the first one, at a step that reduces smoothing."""
_NOT_FITTED = StrengthFit()
_PROJECTED = 1e-5
"""Difference, relative to parameter and first rate, from which a parameter counts as moved by its bounds; below it, as rounded."""


@dataclass(frozen=True)
class ScheduleFreeState:
    """State between steps.

    Attributes:
        step: steps made so far.
        learning_rates: of each parameter, before schedule and decay.
        fast: z, the iterate that takes the steps.
        average: x, the weighted mean of z.
        second_moment: weighted mean of the squared gradient, not debiased.
        gradient: the last one, preconditioned.
        product, square: exponentially weighted sums of g_t g_{t-1}, and of the mean of the squares of both, per element of the
            preconditioned parameters, with `wiener`.
        correlation: {key: ρ, the mean correlation of successive gradients}.
        log_rate: {key: logarithm of the factor that the rate has fallen by}.
        strengths: {key: how strongly the gradient is smoothed}, where that is fitted.
        sizes: {key: root mean square of the first parameters, 1 where that is 0, and at least the first rate}.
        begun: the step at which all this began.
    """

    step: int
    learning_rates: dict[str, float]
    fast: Tree
    average: Tree
    second_moment: Tree
    gradient: Tree
    product: Tree
    square: Tree
    correlation: dict[str, float]
    log_rate: dict[str, float]
    strengths: dict[str, StrengthFit]
    sizes: dict[str, float]
    begun: int = 0

    def upsampled(self, upsampler: Upsampler) -> ScheduleFreeState:
        """See `Upsamplable`: iterates and moments are interpolated; how strongly to smooth is found anew."""
        return replace(
            self,
            fast=upsampler.tree(self.fast),
            average=upsampler.tree(self.average),
            second_moment=upsampler.tree(self.second_moment, SQUARES),
            gradient=upsampler.tree(self.gradient, 1.0),
            product=upsampler.tree(self.product, SQUARES),
            square=upsampler.tree(self.square, SQUARES),
            strengths={key: StrengthFit() if key in upsampler.shares else fit for key, fit in self.strengths.items()},
        )

    def restarted(self, fresh: ScheduleFreeState) -> ScheduleFreeState:
        """See `Restartable`: the schedule goes on, all else begins at this step."""
        return replace(fresh, step=self.step, begun=self.step)


@register
@dataclass(frozen=True)
class ScheduleFree:
    """Adam's steps without momentum on z, the weighted mean x of z, and gradients at a point between the two.

    At step t, counted from 0, with the gradient g at the parameters y:

        z ← z − η_t g / (√v̂ + ε),   x ← (1 − c) x + c z,   y ← (1 − β) z + β x,   c = (1 + r) / (t + 1 + r)

    v̂ is the debiased mean square of g, with decay β₂ over the first 1 / (1 − β₂) steps and of all gradients alike from then on: with a
    decay that stays, steps grow as gradients vanish, and burst (Reddi et al. 2018, "On the Convergence of Adam and Beyond"). r is
    `averaging`: x is the mean of z with weights that grow as t^r. The parameters of a run are its y, near x. An average has less noise than
    an iterate, and parameters that move slowly suit estimators that reuse earlier samples.

    The rate needs no horizon. It is halved at the first step, and then changes by

        log η_{t+1} = log η_t + q max(0, 2 (ρ − s) − 1) − 2 q max(0, −ρ − s) − min(p (1 − max(0, ρ)), 0.6) / (t + 10)

    with `growth` q, `decay` p and the mean correlation ρ of successive gradients of each parameter by itself, of n elements: while they
    agree, the rate grows, up to 3 η_0 times what the parameter itself has grown by (without that factor in `parameterisations`); where they
    contradict one another, as after steps too long, it shrinks; once they are noise it falls as t^-0.6. Of single numbers the last nine
    gradients may agree by chance, hence s = 1/(3 √n), the standard error of ρ. No faster: what is left of the signal has to arrive, and
    averages of iterates take the noise away at any power between 1/2 and 1 (Polyak and Juditsky 1992).

    Each element's step is shortened by the share of its gradient that is signal, as Wiener's filter does,

        max(s, 0.02),   s = S² ⟨g_t g_{t-1}⟩ / S² ⟨(g_t² + g_{t-1}²) / 2⟩

    with means ⟨·⟩ over the last steps and the channels of a cell, and S² over its neighbours: two gradients share the signal, not the
    noise. Where estimates tell what fresh samples do not confirm of that product (`FreshGradient`), that is noise remembered: product and
    ρ count by the share confirmed (`StrengthFit`). Adam's division lets all elements walk alike, and those that the images tell little of
    would walk at random. Parameters that are not in `preconditioned` have no neighbours, and whole steps. So have all without `wiener`:
    where steps draw few of the pixels, two gradients hardly share a pixel, and the share of signal is small everywhere; there only the
    mean over many steps tells signal from noise, and the falling rate sees to that.

    Parameters that bounds have moved take their iterates along. Where smoothing changes, v̂ becomes as large as the gradients of then.
    Where it becomes weaker, the rate begins at 0.3 η_0 or less: the detail left is small, and neighbours share the noise no longer. Where
    it becomes stronger again, z begins again at x: its noise in what hardly moves any more would become that of the mean.

    Args:
        learning_rate: η_0, in units of the parameter, > 0; for the parameters without their own. Or {key: rate, "*": of the others}.
        beta: β, in [0, 1).
        beta_2: β₂, decay of the mean square at first, in [0, 1).
        epsilon: ε, in units of the gradient, > 0.
        averaging: r, >= 0.
        growth: q, >= 0; 0 for a rate that never grows.
        decay: p, >= 0; 0 for a rate that never falls.
        schedule: a further factor of every learning rate by step; see `unrender.schedules.functions`.
        preconditioner: S, applied to the gradients and to the steps of z of the parameters in `preconditioned`. In place of the
            preconditioner of a `Parameter`: with that of the parameter, bounds are met by u = S^-1 x, which knows nothing of them.
            The strength of `Sobolev` is the greatest that is of use: it is fitted to the gradients, see `StrengthFit`.
        preconditioned: keys of parameters.
        wiener: whether the steps of these parameters are shortened by the share of signal.
        parameterisations: {key: name}, such as "log", of the parameters that move by another variable, whose size tells nothing of how
            far they have come; given to those that have none of their own. See `unrender.parameterisations`.
        coarse_to_fine: {key: steps before which the resolution doubles}, of those that have no `CoarseToFine` of their own.
    """

    learning_rate: float | Mapping[str, float] = 0.1
    beta: float = 0.9
    beta_2: float = 0.95
    epsilon: float = 1e-12
    averaging: float = 2.0
    growth: float = 0.1
    decay: float = 1.5
    schedule: Schedule | None = None
    preconditioner: Preconditioner | None = None
    preconditioned: tuple[str, ...] = ()
    wiener: bool = True
    parameterisations: Mapping[str, str] = field(default_factory=dict)
    coarse_to_fine: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    _bound: Mapping[str, tuple[int, Preconditioner]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self):
        rates.check("ScheduleFree", self.learning_rate, self.schedule)
        for name in ("beta", "beta_2"):
            checks.number("ScheduleFree", name, getattr(self, name), above=0.0, below=1.0, inclusive=True)
        checks.number("ScheduleFree", "epsilon", self.epsilon, above=0.0)
        checks.number("ScheduleFree", "averaging", self.averaging, above=0.0, inclusive=True)
        checks.number("ScheduleFree", "growth", self.growth, above=0.0, inclusive=True)
        checks.number("ScheduleFree", "decay", self.decay, above=0.0, inclusive=True)
        keys = self.preconditioned
        if isinstance(keys, str) or not all(isinstance(key, str) for key in keys):
            raise InputError(f"ScheduleFree: preconditioned must be keys of parameters, got {keys!r}")
        object.__setattr__(self, "preconditioned", tuple(keys))
        named = self.parameterisations
        if not isinstance(named, Mapping) or not all(isinstance(x, str) for pair in named.items() for x in pair):
            raise InputError(f"ScheduleFree: parameterisations must be {{key: name}}, got {named!r:.80}")
        if not isinstance(self.coarse_to_fine, Mapping):
            raise InputError(f"ScheduleFree: coarse_to_fine must be {{key: steps}}, got {self.coarse_to_fine!r:.80}")
        steps = {key: checked_steps(f"ScheduleFree: {key}", given) for key, given in self.coarse_to_fine.items()}
        object.__setattr__(self, "coarse_to_fine", steps)

    @property
    def requires(self) -> Capabilities:
        """A gradient."""
        return Capabilities(Gradient)

    def on_meshes(
        self, topology: Callable[[str], MeshTopology | None], repeated: Callable[[str], int] | None = None
    ) -> ScheduleFree:
        """See `OnMeshes.on_meshes`."""
        smooth, bound = self.preconditioner, {}
        for key in self.preconditioned:
            if isinstance(smooth, MeshPreconditioner) and (mesh := topology(key)) is not None:
                bound[key] = len(mesh.places), smooth.on_mesh(mesh)
            elif isinstance(smooth, PeriodicPreconditioner) and repeated and (columns := repeated(key)):
                bound[key] = 0, smooth.on_repeated(columns)
        optimizer = replace(self)
        object.__setattr__(optimizer, "_bound", bound)
        return optimizer

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> ScheduleFreeState:
        """See `Optimizer.init`. Raises `InputError` for a parameter that the preconditioner does not suit, or an unknown one."""
        own = rates.per_parameter("ScheduleFree", parameters, self.learning_rate, learning_rates)
        for key in self.preconditioned:
            if key not in parameters:
                raise InputError(f'ScheduleFree: preconditioned: unknown parameter "{key}"')
            if self.preconditioner is not None:
                self._smooth(key).check(key, arrays.shape(parameters[key]))
        iterate = dict(parameters)
        zeros = trees.zeros_like(parameters)
        ones = dict.fromkeys(parameters, 1.0)
        none = dict.fromkeys(parameters, 0.0)
        smooth = self.preconditioner
        for name in ("parameterisations", "coarse_to_fine"):
            if unknown := next((key for key in getattr(self, name) if key not in parameters), None):
                raise InputError(f'ScheduleFree: {name}: unknown parameter "{unknown}"')
        smoothed = () if smooth is None else self.preconditioned
        near = {key: zeros[key] for key in smoothed} if self.wiener else {}
        fits = dict.fromkeys(smoothed if isinstance(smooth, Sobolev) else (), StrengthFit())
        sizes = {
            key: max(root_mean_square(x, arrays.number(arrays.total(x * x))) or 1.0, own[key])
            for key, x in parameters.items()
        }
        return ScheduleFreeState(0, own, iterate, iterate, zeros, zeros, near, near, ones, none, fits, sizes)

    def update(self, estimate: Estimate, state: ScheduleFreeState, parameters: Tree) -> tuple[Tree, ScheduleFreeState]:
        """See `Optimizer.update`. Waits for the device: the correlation of gradients and the parameters' size are read."""
        made = state.step - state.begun
        weight_of_square, weights = _mean_square(self.beta_2, made)
        debias = 1.0 / math.sqrt(weights)
        factor = rates.factor("ScheduleFree", self.schedule, state.step) * min(1.0, (made + 1) / _WARMUP)
        weight = (1.0 + self.averaging) / (made + 1.0 + self.averaging)

        strengths = self._fitted(state, estimate) if made > 0 else self._begun(state, estimate)
        maps = self._preconditioners(strengths)
        gradient = {key: maps[key].apply(g) if key in maps else g for key, g in estimate.gradient.items()}
        correlation, log_rate = state.correlation, state.log_rate
        product, square = state.product, state.square
        if made > 0:
            correlation, log_rate = self._rates(state, gradient, parameters, strengths)
            product, square = _remember(state, gradient, strengths)

        steps: Tree = {}
        fast: Tree = {}
        average: Tree = {}
        second: Tree = {}
        for key, g in gradient.items():
            y = parameters[key]
            fit = strengths.get(key, _NOT_FITTED)
            before = state.second_moment[key]
            if fit.level > 0.0 and (whole := arrays.number(arrays.total(before))) > 0.0:
                before = before * arrays.scalar(fit.level * _mean_square(self.beta_2, made - 1)[1] / whole, g)
            before = before * arrays.scalar(1.0 - weight_of_square, g)
            second[key] = before + arrays.scalar(weight_of_square, g) * (g * g)
            root = arrays.sqrt(second[key]) * arrays.scalar(debias, g)
            direction = g / (root + self.epsilon)
            if key in maps:
                direction = maps[key].apply(direction)
            if key in product:
                cells = self._bound[key][0] if key in self._bound else 0
                share = signal_share(maps[key], product[key], square[key], _MEMORY**made, fit.confirmed, cells)
                direction = direction * share
            rate = -state.learning_rates[key] * factor * math.exp(log_rate[key])
            tolerance = state.learning_rates[key] * _PROJECTED
            before, mean = self._within_bounds(state.fast[key], state.average[key], y, tolerance)
            if fit.gain < 1.0:
                before = mean
            fast[key] = before + arrays.scalar(rate, g) * direction
            average[key] = mean + arrays.scalar(weight, g) * (fast[key] - mean)
            steps[key] = self._between(fast[key], average[key]) - y
        following = replace(
            state,
            step=state.step + 1,
            fast=fast,
            average=average,
            second_moment=second,
            gradient=gradient,
            product=product,
            square=square,
            correlation=correlation,
            log_rate=log_rate,
            strengths=strengths,
        )
        return steps, following

    def choices(self, state: ScheduleFreeState) -> tuple[str, ...]:
        """See `Choosing`: how strongly gradients are smoothed, and how far the rate has come."""
        fitted = [f"{key} {fit.share:.2g}" for key, fit in state.strengths.items() if fit.count]
        changed = [f"{key} {math.exp(log):.2g}" for key, log in state.log_rate.items() if state.step > state.begun]
        lines = {"smoothing, as a share of the strongest": fitted, "learning rate, over the first": changed}
        return tuple(f"{what}: {listed(parts)}" for what, parts in lines.items() if parts)

    def _rates(
        self, state: ScheduleFreeState, gradient: Tree, parameters: Tree, strengths: Mapping[str, StrengthFit]
    ) -> tuple[dict[str, float], dict[str, float]]:
        """The next mean correlations, and logarithms of the rates' factors: at a step that changes the smoothing, no rate is
        above its first, or 0.3 of that where it becomes weaker.
        """
        correlation, log_rate = {}, {}
        for key, (cosine, size) in measured(gradient, state.gradient, parameters).items():
            rho = correlation[key] = _MEMORY * state.correlation[key] + (1.0 - _MEMORY) * cosine
            fit, shape = strengths.get(key, _NOT_FITTED), arrays.shape(gradient[key])
            change = self._change(min(rho, rho * fit.confirmed), shape, state.step - state.begun)
            grown = 1.0 if key in self.parameterisations else max(1.0, size / state.sizes[key])
            most = math.log(_MOST_GROWTH * grown if fit.gain == 1.0 else _REFINED if fit.gain > 1.0 else 1.0)
            log_rate[key] = min(state.log_rate[key] + change, most)
        return correlation, log_rate

    def _change(self, correlation: float, shape: tuple[int, ...], made: int) -> float:
        """Of the logarithm of the rate, in one step."""
        power = min(self.decay * (1.0 - max(0.0, correlation)), _STEEPEST)
        error = 1.0 / math.sqrt(_PAIRS * max(1, math.prod(shape)))
        change = self.growth * (max(0.0, 2.0 * (correlation - error) - 1.0) - 2.0 * max(0.0, -correlation - error))
        return change - power / (made + _DELAY)

    def _begun(self, state: ScheduleFreeState, estimate: Estimate) -> dict[str, StrengthFit]:
        """The strengths after the first gradient."""
        return {
            key: fit.begun(cast("Sobolev", self._smooth(key)), estimate.gradient[key])
            for key, fit in state.strengths.items()
        }

    def _fitted(self, state: ScheduleFreeState, estimate: Estimate) -> dict[str, StrengthFit]:
        """The strengths after another gradient."""
        found = estimate.get(FreshGradient)
        fresh: Mapping[str, Array] = {} if found is None else found.values
        return {
            key: fit.after(
                cast("Sobolev", self._smooth(key)), state.gradient[key], estimate.gradient[key], fresh.get(key)
            )
            for key, fit in state.strengths.items()
        }

    def _preconditioners(self, strengths: Mapping[str, StrengthFit]) -> dict[str, Preconditioner]:
        """{key: S} of the parameters that have one."""
        smooth = self.preconditioner
        if smooth is None:
            return {}
        found = {key: self._smooth(key) for key in self.preconditioned}
        return {k: s.scaled(strengths[k].share) if isinstance(s, Sobolev) else s for k, s in found.items()}

    def _smooth(self, key: str) -> Preconditioner:
        """The preconditioner of a parameter in `preconditioned`, all of it."""
        found = self._bound[key][1] if key in self._bound else self.preconditioner
        assert found is not None
        return found

    def _between(self, fast: Array, average: Array) -> Array:
        """y."""
        return fast + self.beta * (average - fast)

    def _within_bounds(self, fast: Array, average: Array, y: Array, least: float) -> tuple[Array, Array]:
        """z and x on the same side of a bound as the parameters y, where the bound has moved y by more than `least`."""
        planned = self._between(fast, average)
        tolerance = arrays.absolute(planned) * _PROJECTED + least
        above, below = planned - y > tolerance, y - planned > tolerance

        def moved(x: Array) -> Array:
            return arrays.where(above, arrays.minimum(x, y), arrays.where(below, arrays.maximum(x, y), x))

        return moved(fast), moved(average)


def _mean_square(beta_2: float, made: int) -> tuple[float, float]:
    """The weight of a step's squared gradient in the mean square: the lesser of 1 - β₂ and 1 / count; and the sum of all weights so far.

    Args:
        beta_2: β₂.
        made: steps before this one.
    """
    count, alike = made + 1, math.floor(1.0 / (1.0 - beta_2))
    left = beta_2 ** min(count, alike) * min(1.0, alike / count)
    return min(1.0 - beta_2, 1.0 / count), 1.0 - left


def _remember(state: ScheduleFreeState, gradient: Tree, strengths: Mapping[str, StrengthFit]) -> tuple[Tree, Tree]:
    """`product` and `square` of the next state: what was remembered is of the size that it has with the strengths of this step."""
    product, square = {}, {}
    for key, past in state.product.items():
        gain, g, h = strengths.get(key, _NOT_FITTED).gain, gradient[key], state.gradient[key]
        memory = arrays.scalar(_MEMORY * gain, g)
        h = h * arrays.scalar(math.sqrt(gain), g)
        product[key] = memory * past + g * h
        square[key] = memory * state.square[key] + 0.5 * (g * g + h * h)
    return product, square
