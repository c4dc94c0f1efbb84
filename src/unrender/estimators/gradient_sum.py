"""Sum of the gradients of a step's frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np

from unrender.core import arrays, memory
from unrender.core.arrays import Array
from unrender.core.trees import Tree

_SIDE = 9  # side of the square of pixels over which variances are averaged, twice


def damping(residual: Array, variance: Array, tolerance: float) -> Array:
    """Return |r| / √(r² + κ² σ²) for residuals r (..., H, W, 3), variances σ² of the image (H, W, 3) and tolerance κ > 0. Times the
    derivative of |r|, it is the derivative of Charbonnier's loss √(r² + δ²), with δ = κ σ."""
    square = residual * residual
    return arrays.sqrt(square / (square + (tolerance * tolerance) * variance + 1e-20))


def smoothed_variance(variance: Array, views: Sequence[tuple[slice, tuple[int, int]]] = ()) -> Array:
    """Return the variance (H, W, 3) averaged over neighbouring pixels, since the sample variance of few samples misses rare fireflies.

    Waits for the device.

    Args:
        views: slice and (height, width) of each view in a variance (N, 3) of pixels, which is 0 outside of them.
    """
    values = arrays.numpy(variance)
    if not views:
        return arrays.like(_averaged(values), variance)
    averaged = np.zeros_like(values)
    for rows, size in views:
        averaged[rows] = _averaged(values[rows].reshape(*size, 3)).reshape(-1, 3)
    return arrays.like(averaged, variance)


def _averaged(values: np.ndarray) -> np.ndarray:
    from scipy import ndimage

    for _ in range(2):
        for axis in (0, 1):
            values = ndimage.uniform_filter1d(values, _SIDE, axis, mode="nearest")
    return values.clip(min=0.0)


class GradientSum:
    """Sum of trees in order, in double precision and rounded once. Results for different divisions of views among workers therefore
    differ at most in the last bit.

    Small arrays are stored and added by one kernel. For large arrays, two are stored, or their sum in double precision, to which others
    are added in place. The memory is then independent of the number of views.
    """

    def __init__(self) -> None:
        self._parts: dict[str, list[Array]] = {}
        self._wide: dict[str, Array] = {}

    def add(self, tree: Tree) -> None:
        """Add a tree with the keys and shapes of the others."""
        for key, x in tree.items():
            parts = self._parts.setdefault(key, [])
            if not memory.is_large(x) or (len(parts) < 2 and key not in self._wide):
                parts.append(x)
                continue
            if key not in self._wide:
                self._wide[key] = _wide(parts[0]) + _wide(parts[1])
                arrays.evaluate(self._wide[key])
                parts[:] = [dr.zeros(type(x), arrays.shape(x))]  # a literal, which only retains shape and type
            _add(self._wide[key], x)

    def result(self) -> Tree:
        """Return the sum, {} if nothing was added, and clear it. Large arrays are evaluated."""
        sums = {key: self._rounded(key, parts) for key, parts in self._parts.items()}
        self._parts.clear()
        return sums

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
    kind: Any = dr.float64_array_t(dr.array_t(x))
    return kind(arrays.flat(x))


def _add(total: Array, x: Array) -> None:
    index = dr.arange(dr.uint32_array_t(dr.array_t(x)), dr.width(total))
    dr.scatter_add(total, _wide(x), index, mode=dr.ReduceMode.NoConflicts)
    memory.evaluate_in_turn(total)
