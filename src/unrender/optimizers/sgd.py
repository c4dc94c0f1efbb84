"""Stochastic gradient descent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from unrender.core import checks
from unrender.core.registry import register
from unrender.optimizers import rates
from unrender.optimizers.chain import Recipe
from unrender.optimizers.transforms.base import StepTransform
from unrender.optimizers.transforms.momentum import DecayingSum
from unrender.schedules.functions import Schedule


@register
@dataclass(frozen=True)
class SGD(Recipe):
    """Steps −η u with the velocity u ← μ u + g (Polyak's heavy ball).

    For a constant gradient g the steps converge to −η g / (1 − μ). The chain is `DecayingSum`.

    Args:
        learning_rate: η, in units of the parameter squared per unit of loss, > 0, for the parameters without their own; or {key: rate,
            "*": rate of the others}.
        momentum: μ, in [0, 1).
        schedule: factor of every learning rate by step; see `unrender.schedules.functions`.
    """

    learning_rate: float | Mapping[str, float] = 0.01
    momentum: float = 0.0
    schedule: Schedule | None = None

    def __post_init__(self):
        rates.check("SGD", self.learning_rate, self.schedule)
        checks.number("SGD", "momentum", self.momentum, above=0.0, below=1.0, inclusive=True)

    def compose(self) -> tuple[StepTransform, ...]:
        return (DecayingSum(self.momentum),)
