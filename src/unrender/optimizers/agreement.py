"""How far two gradients agree: sums of products, one kernel for all pairs where they are long."""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.trees import Tree

__all__ = ["inner_products", "measured", "root_mean_square"]

_LONG, _PARTS = 1 << 20, 16
"""Elements from which sums of products are of 16 parts first, all pairs at once, lest each product is stored."""


def inner_products(pairs: Sequence[tuple[Array, Array]]) -> list[Array]:
    """Σ x y over all elements of each pair (x, y) of equal shapes and kinds, left lazy on Dr.Jit."""
    if not pairs or not arrays.is_drjit(pairs[0][0]) or math.prod(pairs[0][0].shape) < _LONG:
        return [arrays.total(x * y) for x, y in pairs]
    parts = []
    for x, y in pairs:
        arrays.evaluate(x, y)
        one, other, kind = arrays.flat(x), arrays.flat(y), dr.uint32_array_t(dr.array_t(x))
        count = dr.width(one)
        size = -(-count // _PARTS)
        index = dr.arange(kind, size)
        found = dr.zeros(type(one), size)
        for part in range(_PARTS):
            within = index < count - part * size if (part + 1) * size > count else True
            left, right = (dr.gather(type(one), z, index + part * size, within) for z in (one, other))
            found = found + left * right
        parts.append(found)
    arrays.evaluate(parts)
    return [dr.sum(part) for part in parts]


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
