"""Schedule-free Adam (Defazio et al. 2024, "The Road Less Scheduled"), whose learning rate decays with the gradient's noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from unrender.core import checks
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.optimizers import rates
from unrender.optimizers.chain import ChainState, Recipe
from unrender.optimizers.transforms.agreement_rate import AgreementRate
from unrender.optimizers.transforms.base import StepTransform, checked_keys
from unrender.optimizers.transforms.fitted_sobolev import ApplyPreconditioner, FittedSobolev
from unrender.optimizers.transforms.scale import ScaleByRms
from unrender.optimizers.transforms.schedule_free_average import ScheduleFreeAverage
from unrender.optimizers.transforms.wiener_shrinkage import WienerShrinkage
from unrender.preconditioners.base import Preconditioner
from unrender.preconditioners.mesh import MeshTopology
from unrender.schedules.functions import Schedule


@register
@dataclass(frozen=True)
class ScheduleFree(Recipe):
    """Adam's steps without momentum on z, the weighted mean x of z, and gradients at a point between the two.

    At step t, counted from 0, with the gradient g at the parameters y:

        z ← z − η_t w g / (√v̂ + ε),   x ← (1 − c) x + c z,   y ← (1 − β) z + β x,   c = (1 + r) / (t + 1 + r)

    The parameters of a run are its y, near x. An average has less noise than an iterate, and parameters that move slowly suit estimators
    that reuse earlier samples. The chain has six transforms, each with its formula in its own docstring:

    - `FittedSobolev` smooths the gradients of `preconditioned` by S, whose strength it fits to them.
    - `AgreementRate` sets η_t. The rate needs no horizon; it decays with the gradient's noise.
    - `ScaleByRms` divides by √v̂ + ε. All gradients have equal weight in v̂ from step 1 / (1 − β₂) on.
    - `ApplyPreconditioner` applies S again, to the direction.
    - `WienerShrinkage` multiplies by w: elements of little signal take short steps.
    - `ScheduleFreeAverage` moves z, x and y.

    Adam normalises every element's step, so weakly observed elements follow a random walk: w stops that. Parameters outside
    `preconditioned` have no neighbours to estimate w from, and unscaled steps. Pass `wiener=False` for pixel mini-batches. Two successive
    gradients then hardly share a pixel, so their product shows little signal everywhere. The decaying rate averages the noise instead.

    Where the smoothing becomes weaker, the rate starts at 0.3 η_0 or less: neighbours no longer average the noise. Where it becomes
    stronger again, z starts again at x.

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
        reparameterised: Keys of parameters that move by another variable (`unrender.parameterisations`), whose size does not tell how far
            they have come.
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
    reparameterised: tuple[str, ...] = ()
    _smoothing: FittedSobolev = field(default_factory=FittedSobolev, init=False, repr=False, compare=False)

    def __post_init__(self):
        rates.check("ScheduleFree", self.learning_rate, self.schedule)
        for name in ("beta", "beta_2"):
            checks.number("ScheduleFree", name, getattr(self, name), above=0.0, below=1.0, inclusive=True)
        checks.number("ScheduleFree", "epsilon", self.epsilon, above=0.0)
        checks.number("ScheduleFree", "averaging", self.averaging, above=0.0, inclusive=True)
        checks.number("ScheduleFree", "growth", self.growth, above=0.0, inclusive=True)
        checks.number("ScheduleFree", "decay", self.decay, above=0.0, inclusive=True)
        keys = checked_keys("ScheduleFree: preconditioned", self.preconditioned)
        object.__setattr__(self, "preconditioned", keys)
        object.__setattr__(self, "_smoothing", FittedSobolev(self.preconditioner, keys))
        moved = checked_keys("ScheduleFree: reparameterised", self.reparameterised)
        object.__setattr__(self, "reparameterised", moved)

    def on_meshes(
        self, topology: Callable[[str], MeshTopology | None], repeated: Callable[[str], int] | None = None
    ) -> ScheduleFree:
        optimizer = replace(self)
        object.__setattr__(optimizer, "_smoothing", self._smoothing.on_meshes(topology, repeated))
        return optimizer

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> ChainState:
        """See `Optimizer.init`. Raises `InputError` for a parameter that the preconditioner does not suit, or an unknown one."""
        for name in ("preconditioned", "reparameterised"):
            if unknown := next((key for key in getattr(self, name) if key not in parameters), None):
                raise InputError(f'ScheduleFree: {name}: unknown parameter "{unknown}"')
        return super().init(parameters, learning_rates)

    def compose(self) -> tuple[StepTransform, ...]:
        shrunk = self.preconditioned if self.wiener and self.preconditioner is not None else ()
        return (
            self._smoothing,
            AgreementRate(self.growth, self.decay, self.reparameterised),
            ScaleByRms(self.beta_2, self.epsilon, long_memory=True),
            ApplyPreconditioner(),
            WienerShrinkage(shrunk),
            ScheduleFreeAverage(self.beta, self.averaging),
        )
