"""Stochastic gradient descent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from unrender.core import arrays, checks, trees
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient
from unrender.optimizers import rates
from unrender.problem.upsampling import Upsampler
from unrender.schedules.functions import Schedule

__all__ = ["SGD", "SGDState"]


@dataclass(frozen=True)
class SGDState:
    """State between steps.

    Attributes:
        step: steps made so far.
        learning_rates: of each parameter, before the schedule.
        velocity: the decaying sum of gradients.
    """

    step: int
    learning_rates: dict[str, float]
    velocity: Tree

    def upsampled(self, upsampler: Upsampler) -> SGDState:
        """See `Upsamplable`: the velocity is interpolated."""
        return replace(self, velocity=upsampler.tree(self.velocity, 1.0))

    def restarted(self, fresh: SGDState) -> SGDState:
        """See `Restartable`: the schedule goes on."""
        return replace(fresh, step=self.step)


@register
@dataclass(frozen=True)
class SGD:
    """Steps −η u with the velocity u ← μ u + g (Polyak's heavy ball).

    A constant gradient g ends in steps of −η g / (1 − μ).

    Args:
        learning_rate: η, in units of the parameter squared per unit of loss, > 0; for the parameters without their own.
        momentum: μ, in [0, 1).
        schedule: factor of every learning rate by step; see `unrender.schedules.functions`.
    """

    learning_rate: float = 0.01
    momentum: float = 0.0
    schedule: Schedule | None = None

    def __post_init__(self):
        rates.check("SGD", self.learning_rate, self.schedule)
        checks.number("SGD", "momentum", self.momentum, above=0.0, below=1.0, inclusive=True)

    @property
    def requires(self) -> Capabilities:
        """A gradient."""
        return Capabilities(Gradient)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> SGDState:
        """See `Optimizer.init`."""
        own = rates.per_parameter("SGD", parameters, self.learning_rate, learning_rates)
        return SGDState(0, own, trees.zeros_like(parameters))

    def update(self, estimate: Estimate, state: SGDState, parameters: Tree) -> tuple[Tree, SGDState]:
        """See `Optimizer.update`. Lazy on Dr.Jit: evaluate steps and state together."""
        del parameters
        velocity = trees.map(lambda u, g: self.momentum * u + g, state.velocity, estimate.gradient)
        factor = rates.factor("SGD", self.schedule, state.step)
        steps = {key: u * arrays.scalar(-state.learning_rates[key] * factor, u) for key, u in velocity.items()}
        return steps, replace(state, step=state.step + 1, velocity=velocity)
