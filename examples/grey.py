from dataclasses import dataclass

import unrender as ur
from unrender.core import arrays, checks
from unrender.core.errors import InputError


@ur.register
@dataclass(frozen=True)
class Grey(ur.preconditioners.Preconditioner):
    """S = (1 − s) I + s M with the mean M over the last axis: steps of the channels are drawn together.

    Args:
        strength: s, in [0, 1).
    """

    strength: float = 0.5

    def __post_init__(self):
        checks.number("Grey", "strength", self.strength, above=0.0, below=1.0, inclusive=True)

    def check(self, key, shape):
        if not shape:
            raise InputError(f"{key}: preconditioner Grey needs channels, got a single number")

    def apply(self, x):
        values = arrays.numpy(x)
        mean = values.mean(axis=-1, keepdims=True)
        return arrays.like((1 - self.strength) * values + self.strength * mean, x)
