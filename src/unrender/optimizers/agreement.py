"""How far two gradients agree."""

from __future__ import annotations

import math

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.memory import inner_products
from unrender.core.trees import Tree

__all__ = ["measured", "root_mean_square"]


def root_mean_square(x: Array, square: float) -> float:
    """The root mean square of an array whose squares sum up to `square`; 0 of no elements."""
    return math.sqrt(square / max(1, math.prod(arrays.shape(x))))


def measured(gradient: Tree, previous: Tree, parameters: Tree) -> dict[str, tuple[float, float]]:
    """{key: (cosine of the angle between two gradients, 0 where one of them is 0; root mean square of the parameter)}."""
    sums = {
        key: inner_products([(g, previous[key]), (g, g), (previous[key],) * 2, (parameters[key],) * 2])
        for key, g in gradient.items()
    }
    arrays.evaluate(sums)
    found = {}
    for key, parts in sums.items():
        product, one, other, square = (arrays.number(part) for part in parts)
        lengths = math.sqrt(one) * math.sqrt(other)
        found[key] = (product / lengths if lengths > 0 else 0.0, root_mean_square(parameters[key], square))
    return found
