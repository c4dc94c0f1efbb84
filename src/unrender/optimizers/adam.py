"""Adam (Kingma and Ba 2015)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from unrender.core import arrays, checks, trees
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient
from unrender.optimizers import rates
from unrender.problem.upsampling import SQUARES, Upsampler
from unrender.schedules.functions import Schedule

__all__ = ["Adam", "AdamState"]


@dataclass(frozen=True)
class AdamState:
    """State between steps.

    Attributes:
        step: steps made so far.
        learning_rates: of each parameter, before the schedule.
        first_moment: exponentially weighted mean of the gradient, not debiased.
        second_moment: of its square.
        begun: the step at which the moments began.
    """

    step: int
    learning_rates: dict[str, float]
    first_moment: Tree
    second_moment: Tree
    begun: int = 0

    def upsampled(self, upsampler: Upsampler) -> AdamState:
        """See `Upsamplable`: the moments are interpolated."""
        first, second = upsampler.tree(self.first_moment, 1.0), upsampler.tree(self.second_moment, SQUARES)
        return replace(self, first_moment=first, second_moment=second)

    def restarted(self, fresh: AdamState) -> AdamState:
        """See `Restartable`: the schedule goes on, the moments begin at this step."""
        return replace(fresh, step=self.step, begun=self.step)


@register
@dataclass(frozen=True)
class Adam:
    """Steps −η m̂ / (√v̂ + ε): the debiased mean of the gradient over the root of its debiased mean square, per
    element.

    At a first gradient g the step is −η sign(g), whatever the loss's scale. Elements whose gradient is 0 keep moving
    by their momentum for some steps.

    Args:
        learning_rate: η, in units of the parameter, > 0; for the parameters without their own. Or {key: rate, "*": of the others}.
        beta_1: decay of the mean, in [0, 1).
        beta_2: decay of the mean square, in [0, 1).
        epsilon: ε, in units of the gradient, > 0.
        schedule: factor of every learning rate by step; see `unrender.schedules.functions`.
        uniform: whether all elements of a parameter share one rate: √v̂ is that of the element with the largest v̂ (Nicolet et al. 2021).
            For vertices of a mesh with `preconditioners.LargeSteps`, whose steps stay as smooth as their gradients.
    """

    learning_rate: float | Mapping[str, float] = 0.01
    beta_1: float = 0.9
    beta_2: float = 0.999
    epsilon: float = 1e-8
    schedule: Schedule | None = None
    uniform: bool = False

    def __post_init__(self):
        rates.check("Adam", self.learning_rate, self.schedule)
        checks.number("Adam", "beta_1", self.beta_1, above=0.0, below=1.0, inclusive=True)
        checks.number("Adam", "beta_2", self.beta_2, above=0.0, below=1.0, inclusive=True)
        checks.number("Adam", "epsilon", self.epsilon, above=0.0)
        if not isinstance(self.uniform, bool):
            raise InputError(f"Adam: uniform must be true or false, got {self.uniform!r}")

    @property
    def requires(self) -> Capabilities:
        """A gradient."""
        return Capabilities(Gradient)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float] | None = None) -> AdamState:
        """See `Optimizer.init`."""
        own = rates.per_parameter("Adam", parameters, self.learning_rate, learning_rates)
        return AdamState(0, own, trees.zeros_like(parameters), trees.zeros_like(parameters))

    def update(self, estimate: Estimate, state: AdamState, parameters: Tree) -> tuple[Tree, AdamState]:
        """See `Optimizer.update`. Lazy on Dr.Jit: evaluate steps and state together."""
        del parameters
        gradient = estimate.gradient
        first = trees.map(lambda m, g: self.beta_1 * m + (1.0 - self.beta_1) * g, state.first_moment, gradient)
        second = trees.map(lambda v, g: self.beta_2 * v + (1.0 - self.beta_2) * (g * g), state.second_moment, gradient)
        made = state.step + 1 - state.begun
        factor = rates.factor("Adam", self.schedule, state.step) / (1.0 - self.beta_1**made)
        debias = 1.0 / math.sqrt(1.0 - self.beta_2**made)

        def step(key: str):
            rate = arrays.scalar(-state.learning_rates[key] * factor, first[key])
            square = arrays.largest(second[key]) if self.uniform else second[key]
            root = arrays.sqrt(square) * arrays.scalar(debias, first[key])
            return rate * (first[key] / (root + self.epsilon))

        return {key: step(key) for key in first}, replace(
            state, step=state.step + 1, first_moment=first, second_moment=second
        )
