"""The sum of the gradients of a step's frames."""

from __future__ import annotations

from typing import Any

import drjit as dr

from unrender.core import arrays, memory
from unrender.core.arrays import Array
from unrender.core.trees import Tree

_SIDE = 9
"""Of the square of pixels that variances are averaged over, twice."""


def damping(residual: Array, variance: Array, tolerance: float) -> Array:
    """|r| / √(r² + κ² σ²): the derivative of |r| times this is that of Charbonnier's loss √(r² + δ²), with δ = κ σ.

    Args:
        residual: r, image minus reference, (..., H, W, 3).
        variance: σ² of the image, (H, W, 3).
        tolerance: κ, > 0.
    """
    square = residual * residual
    return arrays.sqrt(square / (square + (tolerance * tolerance) * variance + 1e-20))


def smoothed_variance(variance: Array) -> Array:
    """The mean of the variance (H, W, 3) over each pixel's neighbours: a pixel whose few samples agreed has not yet seen its fireflies.

    Waits for the device.
    """
    from scipy import ndimage

    values = arrays.numpy(variance)
    for _ in range(2):
        for axis in (0, 1):
            values = ndimage.uniform_filter1d(values, _SIDE, axis, mode="nearest")
    return arrays.like(values.clip(min=0.0), variance)


class GradientSum:
    """Σ of trees in their order, in double precision, rounded to theirs once: however the views are divided among workers, the result is
    the same but for its last bit, now and then.

    Small arrays are kept and added by one kernel. Of large ones two are kept, or their sum in double precision, to which others are added
    in place: as much memory, however many views there are.
    """

    def __init__(self) -> None:
        self._parts: dict[str, list[Array]] = {}
        self._wide: dict[str, Array] = {}

    def add(self, tree: Tree) -> None:
        """One more, of the keys and shapes of the others."""
        for key, x in tree.items():
            parts = self._parts.setdefault(key, [])
            if not memory.is_large(x) or (len(parts) < 2 and key not in self._wide):
                parts.append(x)
                continue
            if key not in self._wide:
                self._wide[key] = _wide(parts[0]) + _wide(parts[1])
                arrays.evaluate(self._wide[key])
                parts[:] = [dr.zeros(type(x), arrays.shape(x))]  # of this form; a literal
            _add(self._wide[key], x)

    def result(self) -> Tree:
        """The sum, {} of none; of large arrays evaluated. Afterwards there is nothing in it."""
        found = {key: self._rounded(key, parts) for key, parts in self._parts.items()}
        self._parts.clear()
        return found

    def _rounded(self, key: str, parts: list[Array]) -> Array:
        like = parts[0]
        if key in self._wide:
            total = arrays.shaped(dr.array_t(like)(self._wide.pop(key)), arrays.shape(like), like)
        else:
            total = arrays.sum_in_double(parts)
        parts.clear()
        if memory.is_large(total):
            memory.evaluate_in_turn(total)
        return total


def _wide(x: Array) -> Array:
    """Flat, in double precision."""
    kind: Any = dr.float64_array_t(dr.array_t(x))
    return kind(arrays.flat(x))


def _add(total: Array, x: Array) -> None:
    """In place."""
    index = dr.arange(dr.uint32_array_t(dr.array_t(x)), dr.width(total))
    dr.scatter_add(total, _wide(x), index, mode=dr.ReduceMode.NoConflicts)
    memory.evaluate_in_turn(total)
