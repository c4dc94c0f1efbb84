"""Transforms that scale the direction element by element."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from unrender.core import arrays, checks, trees
from unrender.core.checks import Fraction, Positive
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.capabilities import Variance
from unrender.optimizers.transforms.base import (
    MEAN_SQUARES,
    SMOOTHING_UNCHANGED,
    StepTransform,
    StepUpdate,
    TransformState,
    checked_keys,
)


@dataclass(frozen=True)
class MeanSquare(TransformState):
    """State of `ScaleByRms`.

    Attributes:
        second_moment: v, the weighted mean of the squared gradient, not debiased.
    """

    second_moment: Tree = field(metadata=MEAN_SQUARES)


@register
@dataclass(frozen=True)
class ScaleByRms(StepTransform):
    """Divide the direction by √v̂ + ε, with the debiased mean v̂ of the squared gradient (Kingma and Ba 2015).

    The result has no unit. If a `FittedSobolev` changes the smoothing, v is rescaled to the gradients with the new smoothing.

    Args:
        decay: β₂, decay of the mean, in [0, 1).
        epsilon: ε, in units of the gradient, > 0.
        uniform: Whether all elements of a parameter are divided by the largest √v̂ among them (Nicolet et al. 2021); or keys of the
            parameters for which this is so.
        long_memory: Whether all gradients have equal weight in v from step 1 / (1 − β₂) on. A constant decay makes steps grow as
            gradients vanish (Reddi et al. 2018, "On the Convergence of Adam and Beyond").
    """

    decay: Fraction = 0.999
    epsilon: Positive = 1e-8
    uniform: bool | tuple[str, ...] = False
    long_memory: bool = False

    def __post_init__(self):
        checks.fields(self)
        if not isinstance(self.uniform, bool):
            object.__setattr__(self, "uniform", checked_keys("ScaleByRms: uniform", self.uniform))

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> MeanSquare:
        return MeanSquare(trees.zeros_like(parameters))

    def update(self, update: StepUpdate, state: MeanSquare) -> tuple[StepUpdate, MeanSquare]:
        """Scale the direction. Waits for the device if the smoothing changes."""
        weight, weights = self._weights(update.made)
        debias = 1.0 / math.sqrt(weights)
        second: Tree = {}
        direction: Tree = {}
        for key, g in update.gradient.items():
            level, before = update.smoothing.get(key, SMOOTHING_UNCHANGED).level, state.second_moment[key]
            if level > 0.0 and (sum_before := arrays.number(arrays.total(before))) > 0.0:
                before = before * arrays.scalar(level * self._weights(update.made - 1)[1] / sum_before, g)
            if self.long_memory:
                before = before * arrays.scalar(1.0 - weight, g)
                second[key] = before + arrays.scalar(weight, g) * (g * g)
            else:
                second[key] = self.decay * before + weight * (g * g)
            uniform = self.uniform if isinstance(self.uniform, bool) else key in self.uniform
            square = arrays.largest(second[key]) if uniform else second[key]
            root = arrays.sqrt(square) * arrays.scalar(debias, g)
            direction[key] = update.direction[key] / (root + self.epsilon)
        return replace(update, direction=direction), MeanSquare(second)

    def _weights(self, made: int) -> tuple[float, float]:
        """Return the weight of a squared gradient after `made` others, and the sum of all weights so far."""
        count = made + 1
        if not self.long_memory:
            return 1.0 - self.decay, 1.0 - self.decay**count
        alike = math.floor(1.0 / (1.0 - self.decay))
        left = self.decay ** min(count, alike) * min(1.0, alike / count)
        return min(1.0 - self.decay, 1.0 / count), 1.0 - left


@register
@dataclass(frozen=True)
class ScaleByDeviation(checks.Checked, StepTransform):
    """Divide the direction by √(Var g + ε), with the variance from the estimator (Balint et al. 2023, Eq. 21).

    The result has no unit.

    Args:
        epsilon: ε, in squared units of the gradient, > 0.
    """

    epsilon: Positive = 1e-24

    requires = (Variance,)

    def update(self, update: StepUpdate, state: None) -> tuple[StepUpdate, None]:
        variance = update.estimate.require("ScaleByDeviation", Variance).values
        direction = {key: x / arrays.sqrt(variance[key] + self.epsilon) for key, x in update.direction.items()}
        return replace(update, direction=direction), None


@register
@dataclass(frozen=True)
class ClipDirection(checks.Checked, StepTransform):
    """Clip every element of the direction.

    Args:
        longest: Largest magnitude of an element, in units of the direction, > 0.
    """

    longest: Positive = 1.0

    def update(self, update: StepUpdate, state: None) -> tuple[StepUpdate, None]:
        most = self.longest * update.divisor

        def clipped(x: arrays.Array) -> arrays.Array:
            limit = most if update.divisor == 1.0 else arrays.scalar(most, x)
            return arrays.clip(x, -limit, limit)

        return replace(update, direction=trees.map(clipped, update.direction)), None
