"""Recipes of first order: Adam (Kingma and Ba 2015), gradient descent, and the rule of meta-estimation (Balint et al. 2023)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from unrender.core import checks
from unrender.core.registry import register
from unrender.optimizers import rates
from unrender.optimizers.chain import Recipe
from unrender.optimizers.transforms.base import StepTransform
from unrender.optimizers.transforms.momentum import DecayingSum, GradientMean
from unrender.optimizers.transforms.scale import ScaleByDeviation, ScaleByRms
from unrender.schedules import Schedule


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
    momentum: float = 0.0
    schedule: Schedule | None = None

    def __post_init__(self):
        rates.check("SGD", self.learning_rate, self.schedule)
        checks.number("SGD", "momentum", self.momentum, above=0.0, below=1.0, inclusive=True)

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
    epsilon: float = 1e-24
    schedule: Schedule | None = None

    def __post_init__(self):
        rates.check("MetaAdam", self.learning_rate, self.schedule)
        checks.number("MetaAdam", "epsilon", self.epsilon, above=0.0)

    def compose(self) -> tuple[StepTransform, ...]:
        return (ScaleByDeviation(self.epsilon),)
