"""Optimizers as chains of transforms, and recipes of first order: Adam (Kingma and Ba 2015), gradient descent, the rule of meta-estimation
(Balint et al. 2023), and schedule-free Adam (Defazio et al. 2024, "The Road Less Scheduled"), whose learning rate decays with the
gradient's noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

from unrender.core import arrays, checks
from unrender.core.checks import Fraction, NotNegative, Positive, PositiveByKey
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient
from unrender.optimizers.base import check_rates, rates_of
from unrender.optimizers.transforms.agreement_rate import AgreementRate
from unrender.optimizers.transforms.averages import DecayingSum, GradientMean, ScheduleFreeAverage
from unrender.optimizers.transforms.base import StepTransform, StepUpdate, checked_keys, checked_transforms
from unrender.optimizers.transforms.fitted_sobolev import ApplyPreconditioner, FittedSobolev
from unrender.optimizers.transforms.lasting_agreement import LastingAgreement
from unrender.optimizers.transforms.scale import ScaleByDeviation, ScaleByRms
from unrender.optimizers.transforms.shrinkage import PullToStart, WienerShrinkage
from unrender.preconditioners.base import Preconditioner
from unrender.scene.upsampling import Upsampler, restarted, upsampled
from unrender.schedules import Schedule, schedule_factor

S = TypeVar("S")


@dataclass(frozen=True)
class ChainState:
    """State of a chain between steps: those of the transforms, in order, which started at the step `begun`, and {key: η} without schedule
    and factors."""

    step: int
    learning_rates: dict[str, float]
    states: tuple[Any, ...]
    begun: int = 0

    def of(self, kind: type[S]) -> S:
        """Return the first state of this type. Raise `KeyError` if there is none."""
        for state in self.states:
            if isinstance(state, kind):
                return state
        raise KeyError(kind.__name__)

    def upsampled(self, upsampler: Upsampler) -> ChainState:
        return replace(self, states=tuple(upsampled(state, upsampler) for state in self.states))

    def restarted(self, fresh: ChainState) -> ChainState:
        """Continue the schedule, and restart the transforms at this step."""
        pairs = zip(self.states, fresh.states, strict=True)
        states = tuple(restarted(state, begun) for state, begun in pairs)
        return replace(fresh, step=self.step, begun=self.step, states=states)


class Recipe(ABC):
    """An optimizer that is a composition of transforms. Subclasses are registered frozen dataclasses."""

    learning_rate: Any
    schedule: Schedule | None

    @abstractmethod
    def compose(self) -> tuple[StepTransform, ...]:
        """Return the transforms, first to last."""

    @cached_property
    def _composed(self) -> tuple[StepTransform, ...]:
        return self.compose()

    @property
    def requires(self) -> Capabilities:
        """A gradient, and the capabilities that the transforms require."""
        return Capabilities(Gradient, *(kind for part in self._composed for kind in part.requires))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> ChainState:
        own = rates_of(type(self).__name__, parameters, self.learning_rate, learning_rates)
        return ChainState(0, own, tuple(part.init(parameters, own) for part in self._composed))

    def update(self, estimate: Estimate, state: ChainState, parameters: Tree) -> tuple[Tree, ChainState]:
        """Return the steps and the next state. Lazy on Dr.Jit unless a transform waits: evaluate both together."""
        factor = schedule_factor(type(self).__name__, self.schedule, state.step)
        if not 0 <= state.begun <= state.step:
            raise InputError(f"state of {type(self).__name__}: begun at step {state.begun}, is at step {state.step}")
        made, gradient = state.step - state.begun, estimate.gradient
        update = StepUpdate(estimate, parameters, made, state.learning_rates, gradient, gradient, factor)
        states = []
        for part, before in zip(self._composed, state.states, strict=True):
            update, after = part.update(update, before)
            states.append(after)
        steps = {
            key: update.steps[key] if key in update.steps else arrays.scalar(-update.rate(key), x) * x
            for key, x in update.direction.items()
        }
        return steps, replace(state, step=state.step + 1, states=tuple(states))

    def choices(self, state: ChainState) -> tuple[str, ...]:
        made, pairs = state.step - state.begun, zip(self._composed, state.states, strict=True)
        return tuple(line for part, own in pairs for line in part.choices(own, made))


@register
@dataclass(frozen=True)
class Chain(Recipe):
    """Sequence of transforms, followed by a step against the direction: −η × direction.

        Chain((GradientMean(0.9), ScaleByRms(0.999)), learning_rate=0.01)

    This example is Adam. A transform gets the direction from the previous one, so the order matters.

    Args:
        transforms: Transforms in order; see `unrender.optimizers.transforms`.
        learning_rate: η, in units of the parameter for a direction of size 1, > 0; or {key: rate, "*": rate of the others}.
        schedule: Factor of every learning rate by step; see `unrender.schedules`.
    """

    transforms: tuple[StepTransform, ...] = ()
    learning_rate: float | Mapping[str, float] = 0.01
    schedule: Schedule | None = None

    def __post_init__(self):
        checks.fields(self)
        check_rates("Chain", self.learning_rate, self.schedule)
        object.__setattr__(self, "transforms", checked_transforms("Chain: transforms", self.transforms))

    def compose(self) -> tuple[StepTransform, ...]:
        return self.transforms


@register
@dataclass(frozen=True)
class Adam(Recipe):
    """Steps −η m̂ / (√v̂ + ε), with the debiased mean m̂ and the debiased mean square v̂ of the gradient, per element.

    The first step for a gradient g is −η sign(g), whatever the scale of the loss. Elements whose gradient becomes 0 continue by momentum
    for some steps. The chain is `GradientMean`, `ScaleByRms`.

    Args:
        learning_rate: η, in units of the parameter, > 0, for the parameters without their own; or {key: rate, "*": rate of the others}.
        beta_1: decay of the mean, in [0, 1).
        beta_2: decay of the mean square, in [0, 1).
        epsilon: ε, in units of the gradient, > 0.
        schedule: factor of every learning rate by step; see `unrender.schedules`.
        uniform: whether all elements of a parameter share the largest v̂ (Nicolet et al. 2021). It suits mesh vertices with
            `preconditioners.LargeSteps`, because steps stay as smooth as the gradients.
    """

    learning_rate: float | Mapping[str, float] = 0.01
    beta_1: Fraction = 0.9
    beta_2: Fraction = 0.999
    epsilon: Positive = 1e-8
    schedule: Schedule | None = None
    uniform: bool = False

    def __post_init__(self):
        check_rates("Adam", self.learning_rate, self.schedule)
        checks.fields(self)

    def compose(self) -> tuple[StepTransform, ...]:
        return GradientMean(self.beta_1), ScaleByRms(self.beta_2, self.epsilon, self.uniform)


@register
@dataclass(frozen=True)
class SGD(Recipe):
    """Steps −η u with the velocity u ← μ u + g (Polyak's heavy ball).

    For a constant gradient g the steps converge to −η g / (1 − μ). The chain is `DecayingSum`.

    Args:
        learning_rate: η, in units of the parameter squared per unit of loss, > 0, for the parameters without their own; or {key: rate,
            "*": rate of the others}.
        momentum: μ, in [0, 1).
        schedule: factor of every learning rate by step; see `unrender.schedules`.
    """

    learning_rate: float | Mapping[str, float] = 0.01
    momentum: Fraction = 0.0
    schedule: Schedule | None = None

    def __post_init__(self):
        check_rates("SGD", self.learning_rate, self.schedule)
        checks.fields(self)

    def compose(self) -> tuple[StepTransform, ...]:
        return (DecayingSum(self.momentum),)


@register
@dataclass(frozen=True)
class MetaAdam(Recipe):
    """Steps −η g / √(Var g + ε), per element (Eq. 21), with the variance from the estimator.

    Adam divides by the root mean square of many gradients, which it assumes to be independent. A meta-estimate is already an average, and
    correlated with earlier ones. Here the divisor is the standard deviation of the current gradient. Where noise dominates, the step is
    about η at most. Where many samples agree, it grows with their number: up to η √n after n steps of a constant gradient, where Var g is
    the mean square of a sample. It decreases when the gradient or the weight of the past becomes small. So learning rates are lower
    than Adam's, and one learning rate serves the start and the end of a run.

    The noise of successive meta-estimates is correlated, so the steps of a noisy element do not average out. After n steps with full
    weight of the past it has moved by about 0.8 η n, whereas Adam with independent gradients moves it by η √n: a factor of 14 after 300
    steps.

    At the first step a meta-estimate's variance is its square, and the step is −η sign(g), as in Adam. The chain is `ScaleByDeviation`
    alone; put `ClipDirection` behind it to limit the steps.

    Args:
        learning_rate: η, in units of the parameter, > 0, for the parameters without their own; or {key: rate, "*": rate of the others}.
        epsilon: ε, in squared units of the gradient, > 0. Elements whose gradient and variance are both 0 do not move. It is far below
            Adam's ε, which is outside the root: a texel's gradient of a mean over pixels is small.
        schedule: factor of every learning rate by step; see `unrender.schedules`.
    """

    learning_rate: float | Mapping[str, float] = 0.002
    epsilon: Positive = 1e-24
    schedule: Schedule | None = None

    def __post_init__(self):
        check_rates("MetaAdam", self.learning_rate, self.schedule)
        checks.fields(self)

    def compose(self) -> tuple[StepTransform, ...]:
        return (ScaleByDeviation(self.epsilon),)


@register
@dataclass(frozen=True)
class ScheduleFree(Recipe):
    """Adam steps without momentum on z, with gradients at a point between z and its weighted mean x.

    At step t, counted from 0, with the gradient g at the parameters y:

        z ← z − η_t w g / (√v̂ + ε),   x ← (1 − c) x + c z,   y ← (1 − β) z + β x,   c = (1 + r_t) / (t + 1 + r_t)

    with r_t = r, and r (t + 48) / (t + 16) in `preconditioned`. The result of a run is y, which is near x. An average has less noise than
    an iterate, and slowly moving parameters suit estimators that reuse earlier samples. The chain has seven transforms, whose docstrings
    contain their formulas:

    - `FittedSobolev` smooths the gradients of `preconditioned` by S, whose strength it fits to them.
    - `LastingAgreement` estimates how much of the agreement of gradients is reused noise.
    - `AgreementRate` sets η_t. The rate needs no horizon; it decays with the gradient's noise.
    - `ScaleByRms` divides by √v̂ + ε. All gradients have equal weight in v̂ from step 1 / (1 − β₂) on.
    - `ApplyPreconditioner` applies S again, to the direction.
    - `WienerShrinkage` multiplies by w, which shortens the steps of elements with little signal.
    - `ScheduleFreeAverage` updates z, x and y.

    Adam normalises every element's step, so weakly observed elements follow a random walk, which w prevents. Parameters outside of
    `preconditioned` have no neighbours from which w can be estimated, and take unscaled steps; those in `uniform` take steps in proportion
    to their gradients. Use `wiener=False` with pixel mini-batches: two successive gradients then hardly share a pixel, so their product
    shows little signal anywhere, and the decaying learning rate averages the noise instead.

    Where the smoothing becomes weaker, the learning rate restarts at 0.3 η_0 or less, because neighbours no longer average the noise.
    Where it becomes stronger again, or the rate falls by more than a quarter at once, z restarts at x.

    Args:
        learning_rate: η_0, in units of the parameter, > 0, for the parameters without their own; or {key: rate, "*": rate of the others}.
        beta: β, in [0, 1).
        beta_2: β₂, initial decay of the mean square, in [0, 1).
        epsilon: ε, in units of the gradient, > 0.
        averaging: r, >= 0; three times as large at first in `preconditioned`.
        growth: q of `AgreementRate`, >= 0; 0 for a rate that never grows.
        decay: p of `AgreementRate`, >= 0; 0 for a rate that never decays.
        schedule: additional factor of every learning rate by step; see `unrender.schedules`.
        preconditioner: S, applied to the gradients and to the steps of z for the parameters in `preconditioned`. It replaces the
            preconditioner of a `Parameter`, which would optimise u = S⁻¹ x without knowledge of the bounds. The strength of `Sobolev` is
            an upper limit; it is fitted to the gradients, see `StrengthFit`.
        preconditioned: keys of parameters.
        wiener: whether the steps of these parameters are multiplied by w.
        reparameterised: Keys of parameters with another variable (`unrender.parameterisations`), whose size does not measure their
            progress.
        uniform: keys of parameters whose elements are all divided by the largest √v̂ among them. Elements that the pictures hardly show
            then hardly move.
        pulled: {key: weight} of parameters with a `PullToStart` before all other transforms.
    """

    learning_rate: float | Mapping[str, float] = 0.1
    beta: Fraction = 0.9
    beta_2: Fraction = 0.95
    epsilon: Positive = 1e-12
    averaging: NotNegative = 2.0
    growth: NotNegative = 0.1
    decay: NotNegative = 1.5
    schedule: Schedule | None = None
    preconditioner: Preconditioner | None = None
    preconditioned: tuple[str, ...] = ()
    wiener: bool = True
    reparameterised: tuple[str, ...] = ()
    uniform: tuple[str, ...] = ()
    pulled: PositiveByKey = field(default_factory=dict)
    _smoothing: FittedSobolev = field(default_factory=FittedSobolev, init=False, repr=False, compare=False)

    def __post_init__(self):
        checks.fields(self)
        check_rates("ScheduleFree", self.learning_rate, self.schedule)
        keys = checked_keys("ScheduleFree: preconditioned", self.preconditioned)
        object.__setattr__(self, "preconditioned", keys)
        object.__setattr__(self, "_smoothing", FittedSobolev(self.preconditioner, keys))
        moved = checked_keys("ScheduleFree: reparameterised", self.reparameterised)
        object.__setattr__(self, "reparameterised", moved)
        object.__setattr__(self, "uniform", checked_keys("ScheduleFree: uniform", self.uniform))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> ChainState:
        """Return the state before the first step. Raises `InputError` for an unknown parameter, or one that S does not support."""
        for name in ("preconditioned", "reparameterised", "uniform", "pulled"):
            if unknown := next((key for key in getattr(self, name) if key not in parameters), None):
                raise InputError(f'ScheduleFree: {name}: unknown parameter "{unknown}"')
        return super().init(parameters, learning_rates)

    def compose(self) -> tuple[StepTransform, ...]:
        shrunk = self.preconditioned if self.wiener and self.preconditioner is not None else ()
        return (
            *((PullToStart(self.pulled),) if self.pulled else ()),
            self._smoothing,
            LastingAgreement(),
            AgreementRate(self.growth, self.decay, self.reparameterised),
            ScaleByRms(self.beta_2, self.epsilon, self.uniform, long_memory=True),
            ApplyPreconditioner(),
            WienerShrinkage(shrunk),
            ScheduleFreeAverage(self.beta, self.averaging),
        )
