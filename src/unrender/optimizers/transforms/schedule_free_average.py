"""Averaged iterates (Defazio et al. 2024, "The Road Less Scheduled")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.checks import Fraction, NotNegative
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.optimizers.transforms.base import VALUES, StepTransform, StepUpdate, TransformState

_WARMUP = 2
"""Number of steps over which the learning rate increases."""
_PROJECTED = 1e-5
"""Difference, relative to the parameter and the first learning rate, above which a parameter counts as projected onto its bounds."""


@dataclass(frozen=True)
class Iterates(TransformState):
    """State of `ScheduleFreeAverage`.

    Attributes:
        fast: z, the iterate that takes the steps.
        average: x, the weighted mean of z.
    """

    fast: Tree = field(metadata=VALUES)
    average: Tree = field(metadata=VALUES)


@register
@dataclass(frozen=True)
class ScheduleFreeAverage(checks.Checked, StepTransform):
    """Take steps on z, average z in x, and place the parameters y between the two. Must be the last transform of a chain.

        z ← z − η_t direction,   x ← (1 − c) x + c z,   y ← (1 − β) z + β x,   c = (1 + r) / (t + 1 + r)

    x is the mean of z with weights that grow as t^r. The learning rate is halved at the first step. Iterates z and x are projected onto
    the bounds together with the parameters. z restarts at x for the parameters in `StepUpdate.restarted`.

    Args:
        beta: β, in [0, 1).
        averaging: r, >= 0.
    """

    beta: Fraction = 0.9
    averaging: NotNegative = 2.0

    @property
    def sets_steps(self) -> bool:
        return True

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> Iterates:
        del learning_rates
        return Iterates(dict(parameters), dict(parameters))

    def update(self, update: StepUpdate, state: Iterates) -> tuple[StepUpdate, Iterates]:
        weight = (1.0 + self.averaging) / (update.made + 1.0 + self.averaging)
        warm = replace(update, factor=update.factor * min(1.0, (update.made + 1) / _WARMUP))
        steps: Tree = {}
        fast: Tree = {}
        average: Tree = {}
        for key, direction in update.direction.items():
            y, tolerance = update.parameters[key], update.learning_rates[key] * _PROJECTED
            before, mean = self._within_bounds(state.fast[key], state.average[key], y, tolerance)
            before = mean if key in update.restarted else before
            fast[key] = before + arrays.scalar(-warm.rate(key), direction) * direction
            average[key] = mean + arrays.scalar(weight, direction) * (fast[key] - mean)
            steps[key] = self._between(fast[key], average[key]) - y
        return replace(update, steps=steps), Iterates(fast, average)

    def _between(self, fast: Array, average: Array) -> Array:
        """Return y."""
        return fast + self.beta * (average - fast)

    def _within_bounds(self, fast: Array, average: Array, y: Array, least: float) -> tuple[Array, Array]:
        """Return z and x clamped to y where a bound has moved y by more than `least`."""
        planned = self._between(fast, average)
        tolerance = arrays.absolute(planned) * _PROJECTED + least
        above, below = planned - y > tolerance, y - planned > tolerance

        def moved(x: Array) -> Array:
            return arrays.where(above, arrays.minimum(x, y), arrays.where(below, arrays.maximum(x, y), x))

        return moved(fast), moved(average)
