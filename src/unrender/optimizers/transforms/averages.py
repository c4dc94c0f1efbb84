"""Means of directions (momentum) and of iterates (Defazio et al. 2024, "The Road Less Scheduled")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from unrender.core import arrays, checks, trees
from unrender.core.arrays import Array
from unrender.core.checks import Fraction, NotNegative
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.optimizers.transforms.base import GRADIENTS, VALUES, StepTransform, StepUpdate, TransformState


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
        return Velocity(trees.zeros_like(parameters))

    def update(self, update: StepUpdate, state: Velocity) -> tuple[StepUpdate, Velocity]:
        velocity = trees.map(lambda u, g: self.momentum * u + g, state.velocity, update.direction)
        return replace(update, direction=velocity), Velocity(velocity)


_WARMUP = 2
"""Number of steps over which the learning rate increases."""
_FIRST, _HALF = 3.0, 16
"""Power r_t of the first steps over r, and number of steps after which half of the difference is left. The first iterates are far from
the solution. Nine problems with textures, one seed, with 30 steps: 0.93 of the error after 5 steps, 0.97 after 10, 0.98 after 56, at most
1.05 (`sunlit-vase`). Numbers keep r: Gauss-Newton steps after path gradients come later with it (`PathThenNewton`)."""
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

        z ← z − η_t direction,   x ← (1 − c) x + c z,   y ← (1 − β) z + β x,   c = (1 + r_t) / (t + 1 + r_t)

    x is the mean of z with weights that grow as t^r_t. The power r_t is r, and r (t + 48) / (t + 16) for parameters that a `FittedSobolev`
    smooths, whose x thus forgets the iterates of the first steps soon. The learning rate is halved at the first step. Iterates z and x are
    projected onto the bounds together with the parameters. z restarts at x for the parameters in `StepUpdate.restarted`.

    Args:
        beta: β, in [0, 1).
        averaging: r, >= 0.
    """

    beta: Fraction = 0.9
    averaging: NotNegative = 2.0

    sets_steps = True

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> Iterates:
        return Iterates(dict(parameters), dict(parameters))

    def update(self, update: StepUpdate, state: Iterates) -> tuple[StepUpdate, Iterates]:
        smoothed = {key for key, change in update.smoothing.items() if change.preconditioner is not None}
        early = (update.made + _FIRST * _HALF) / (update.made + _HALF)
        warm = replace(update, factor=update.factor * min(1.0, (update.made + 1) / _WARMUP))
        steps: Tree = {}
        fast: Tree = {}
        average: Tree = {}
        for key, direction in update.direction.items():
            y, tolerance = update.parameters[key], update.learning_rates[key] * _PROJECTED
            before, mean = self._within_bounds(state.fast[key], state.average[key], y, tolerance)
            before = mean if key in update.restarted else before
            fast[key] = before + arrays.scalar(-warm.rate(key), direction) * direction
            power = self.averaging * (early if key in smoothed else 1.0)
            weight = (1.0 + power) / (update.made + 1.0 + power)
            average[key] = mean + arrays.scalar(weight, direction) * (fast[key] - mean)
            steps[key] = self._between(fast[key], average[key]) - y
        return replace(update, steps=steps), Iterates(fast, average)

    def _between(self, fast: Array, average: Array) -> Array:
        return fast + self.beta * (average - fast)

    def _within_bounds(self, fast: Array, average: Array, y: Array, least: float) -> tuple[Array, Array]:
        """Return z and x clamped to y where a bound has moved y by more than `least`."""
        planned = self._between(fast, average)
        tolerance = arrays.absolute(planned) * _PROJECTED + least
        above, below = planned - y > tolerance, y - planned > tolerance

        def moved(x: Array) -> Array:
            return arrays.where(above, arrays.minimum(x, y), arrays.where(below, arrays.maximum(x, y), x))

        return moved(fast), moved(average)
