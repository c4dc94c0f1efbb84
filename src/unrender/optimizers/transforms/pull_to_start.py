"""A weak pull to the start, for elements that the references hardly determine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from unrender.core import arrays, checks
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.capabilities import FreshGradient
from unrender.optimizers.transforms.base import VALUES, StepTransform, StepUpdate, TransformState


@dataclass(frozen=True)
class Start(TransformState):
    """State of `PullToStart`.

    Attributes:
        values: {key: initial values} of the parameters that are pulled.
    """

    values: Tree = field(metadata=VALUES)

    def restarted(self, fresh: Start) -> Start:
        """Return the values before the first step, and those of `fresh` where shapes have changed."""
        pairs = {key: (self.values[key], x) for key, x in fresh.values.items()}
        return Start({key: old if arrays.shape(old) == arrays.shape(x) else x for key, (old, x) in pairs.items()})


@register
@dataclass(frozen=True)
class PullToStart(StepTransform):
    """Add c L (u − u_0) to the gradient of the loss L, with the initial values u_0.

    This is the derivative of a normal distribution around u_0 (`scene.prior.Prior`) whose likelihood has the residual's present size as
    its noise, c = p / (N τ²), for a loss of |image − reference|^p, N values of all references, and the standard deviation τ. The residual
    is large at first, and noise at last. Elements that the pictures determine better than τ hardly notice it.

    Steps of Adam's length move weakly observed elements as fast as all others, so they compensate errors that other unknowns have at
    first, such as the lower half of a sky those of a wall. Pictures hardly tell them apart, so the gradient takes thousands of steps to
    undo that. The pull keeps such directions near the start. The result is biased towards it.

    Args:
        weights: {key: c}, > 0; other parameters are not pulled.
    """

    weights: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self):
        for key, weight in self.weights.items():
            checks.number("PullToStart", f"weight of {key}", weight, above=0.0)

    def init(self, parameters: Tree, learning_rates: Mapping[str, float]) -> Start:
        del learning_rates
        return Start({key: parameters[key] for key in self.weights})

    def update(self, update: StepUpdate, state: Start) -> tuple[StepUpdate, Start]:
        loss = max(float(update.estimate.loss), 0.0)
        pulls = {
            key: arrays.scalar(self.weights[key] * loss, start) * (update.parameters[key] - start)
            for key, start in state.values.items()
        }
        estimate, fresh = update.estimate, update.estimate.get(FreshGradient)
        if fresh is not None:
            others = (one for one in estimate.capabilities if one is not fresh)
            estimate = replace(estimate, capabilities=(*others, FreshGradient(_sum(fresh.values, pulls))))
        gradient = _sum(update.gradient, pulls)
        return replace(update, estimate=estimate, gradient=gradient, direction=gradient), state


def _sum(gradient: Tree, pulls: Tree) -> Tree:
    return {key: g + pulls[key] if key in pulls else g for key, g in gradient.items()}
