from dataclasses import dataclass, field, replace
from typing import Any

import unrender as ur
from unrender.core import arrays, checks, trees
from unrender.optimizers.transforms.base import MEAN_SQUARES, StepTransform, TransformState


@dataclass(frozen=True)
class LargestSquare(TransformState):
    """State between steps: the largest squared gradient of each element so far."""

    largest: dict[str, Any] = field(metadata=MEAN_SQUARES)


@ur.register
@dataclass(frozen=True)
class ScaleByLargest(StepTransform):
    """Divide the direction by the largest magnitude of each element's gradient so far. The result has no unit.

    Args:
        epsilon: Added to the divisor, in units of the gradient, > 0.
    """

    epsilon: float = 1e-8

    def __post_init__(self):
        checks.number("ScaleByLargest", "epsilon", self.epsilon, above=0.0)

    def init(self, parameters, learning_rates):
        return LargestSquare(trees.zeros_like(parameters))

    def update(self, update, state):
        largest = trees.map(lambda v, g: arrays.maximum(v, g * g), state.largest, update.gradient)
        direction = {key: x / (arrays.sqrt(largest[key]) + self.epsilon) for key, x in update.direction.items()}
        return replace(update, direction=direction), LargestSquare(largest)
