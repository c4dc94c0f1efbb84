"""Transforms with momentum."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from unrender.core import checks, trees
from unrender.core.checks import Fraction
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.optimizers.transforms.base import GRADIENTS, StepTransform, StepUpdate, TransformState


@dataclass(frozen=True)
class MeanDirection(TransformState):
    """State of `GradientMean`.

    Attributes:
        first_moment: m, the exponentially weighted mean of the direction, not debiased.
    """

    first_moment: Tree = field(metadata=GRADIENTS)


@register
@dataclass(frozen=True)
class GradientMean(checks.Checked, StepTransform):
    """Replace the direction by its debiased exponentially weighted mean: m ← β₁ m + (1 − β₁) g (Kingma and Ba 2015).

    It has the unit of the direction. The step applies the debiasing (`StepUpdate.divisor`).

    Args:
        decay: β₁, in [0, 1).
    """

    decay: Fraction = 0.9

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> MeanDirection:
        del learning_rates
        return MeanDirection(trees.zeros_like(parameters))

    def update(self, update: StepUpdate, state: MeanDirection) -> tuple[StepUpdate, MeanDirection]:
        mean = trees.map(lambda m, g: self.decay * m + (1.0 - self.decay) * g, state.first_moment, update.direction)
        divisor = update.divisor * (1.0 - self.decay ** (update.made + 1))
        return replace(update, direction=mean, divisor=divisor), MeanDirection(mean)


@dataclass(frozen=True)
class Velocity(TransformState):
    """State of `DecayingSum`.

    Attributes:
        velocity: u, the decaying sum of directions.
    """

    velocity: Tree = field(metadata=GRADIENTS)


@register
@dataclass(frozen=True)
class DecayingSum(checks.Checked, StepTransform):
    """Replace the direction by its decaying sum: u ← μ u + g (Polyak's heavy ball).

    A constant direction g converges to g / (1 − μ).

    Args:
        momentum: μ, in [0, 1).
    """

    momentum: Fraction = 0.9

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> Velocity:
        del learning_rates
        return Velocity(trees.zeros_like(parameters))

    def update(self, update: StepUpdate, state: Velocity) -> tuple[StepUpdate, Velocity]:
        velocity = trees.map(lambda u, g: self.momentum * u + g, state.velocity, update.direction)
        return replace(update, direction=velocity), Velocity(velocity)
