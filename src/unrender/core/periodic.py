"""Horizontally periodic arrays with repeated border columns, such as the data of Mitsuba's environment maps.

An array (H, W + 2 k, C) with k repeated columns at each end represents W periodic columns: column j repeats column (j - k) mod W of these.
The repeated columns are not independent parameters.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array


def interior_shape(shape: tuple[int, ...], columns: int) -> tuple[int, ...]:
    """Return the shape of an array (H, W + 2 `columns`, ...) without its repeated columns."""
    return shape if not columns else (shape[0], shape[1] - 2 * columns, *shape[2:])


def interior(x: np.ndarray, columns: int) -> np.ndarray:
    """Remove the repeated columns: (H, W + 2 `columns`, ...) -> (H, W, ...)."""
    return x[:, columns : x.shape[1] - columns] if columns else x


def pad(x: np.ndarray, columns: int) -> np.ndarray:
    """Add the repeated columns: (H, W, ...) -> (H, W + 2 `columns`, ...). The inverse of `interior`."""
    return np.ascontiguousarray(x[:, _sources(x.shape[1], columns) - columns]) if columns else x


def repeat(x: Array, columns: int) -> Array:
    """Overwrite the outer columns of an array (H, W + 2 `columns`, C) with copies of the columns that they repeat; itself for 0 columns."""
    if not columns:
        return x
    shape = arrays.shape(x)
    if not arrays.is_drjit(x):
        return pad(interior(np.asarray(x), columns), columns)
    flat = arrays.flat(x)
    index = arrays.like_integers(_elements(shape, columns), flat)
    return arrays.shaped(arrays.gather(flat, index), shape, x)


def _sources(width: int, columns: int) -> np.ndarray:
    """Return, for each of `width` + 2 `columns` columns, the index of the interior column that it repeats."""
    return np.arange(-columns, width + columns) % width + columns


@lru_cache(maxsize=16)
def _elements(shape: tuple[int, ...], columns: int) -> np.ndarray:
    """Return, for each element of an array of this shape, the flat index of the element that it repeats."""
    numbers = np.arange(int(np.prod(shape)), dtype=np.uint32).reshape(shape)
    return numbers[:, _sources(shape[1] - 2 * columns, columns)].reshape(-1)
