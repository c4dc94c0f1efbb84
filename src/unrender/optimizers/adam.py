"""Adam (Kingma and Ba 2015)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from unrender.core import checks
from unrender.core.registry import register
from unrender.optimizers import rates
from unrender.optimizers.chain import Recipe
from unrender.optimizers.transforms.base import StepTransform
from unrender.optimizers.transforms.momentum import GradientMean
from unrender.optimizers.transforms.scale import ScaleByRms
from unrender.schedules.functions import Schedule


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
        schedule: factor of every learning rate by step; see `unrender.schedules.functions`.
        uniform: whether all elements of a parameter share the largest v̂ (Nicolet et al. 2021). It suits mesh vertices with
            `preconditioners.LargeSteps`, because steps stay as smooth as the gradients.
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
        checks.flags(self)

    def compose(self) -> tuple[StepTransform, ...]:
        return GradientMean(self.beta_1), ScaleByRms(self.beta_2, self.epsilon, self.uniform)
