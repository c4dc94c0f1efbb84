"""Parameter trees, dictionaries {name: array}: arithmetic over trees of equal keys, and conversion to one vector on the host."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from unrender.core import arrays

Tree = dict[str, Any]


def map(function: Callable[..., Any], *trees: Tree) -> Tree:
    """Apply `function` to the arrays of equal name."""
    return {name: function(*(tree[name] for tree in trees)) for name in trees[0]}


add = partial(map, operator.add)
"""Return a + b."""
subtract = partial(map, operator.sub)
"""Return a - b."""
zeros_like = partial(map, arrays.zeros_like)
"""Return zeros of the same shapes."""
shapes = partial(map, arrays.shape)
"""Return the shape of each array."""
numpy = partial(map, arrays.numpy)
"""Return NumPy copies of the arrays."""


def ravel(tree: Tree) -> np.ndarray:
    """Concatenate all elements in key order, (n,), in double precision. Waits for the device."""
    return np.concatenate([arrays.numpy(x).ravel().astype(np.float64) for x in tree.values()])


def parts(vectors: np.ndarray, like: Tree) -> dict[str, np.ndarray]:
    """Split vectors (..., n) into {key: array (..., *shape)} with the shapes of `like`."""
    result, start = {}, 0
    for key, x in like.items():
        shape = arrays.shape(x)
        size = math.prod(shape)
        result[key] = vectors[..., start : start + size].reshape((*vectors.shape[:-1], *shape))
        start += size
    return result


def unravel(vector: np.ndarray, like: Tree) -> Tree:
    """Return a tree with the shapes and types of `like` from a vector (n,); the inverse of `ravel`. The arrays own their memory."""
    return {key: arrays.like(part, like[key]) for key, part in parts(vector, like).items()}


def repeat_per_element(numbers: Mapping[str, float | np.ndarray], like: Tree) -> np.ndarray:
    """Return a vector (n,) in the order of `ravel` from {key: number or array}; a number is repeated for each element."""
    return np.concatenate(
        [np.broadcast_to(np.asarray(numbers[key], float), arrays.shape(x)).ravel() for key, x in like.items()]
    )


def clip_norm(step: np.ndarray, radius: float | None) -> np.ndarray:
    """Scale `step` down to the length `radius` if it is longer. None means no limit."""
    length = float(np.linalg.norm(step))
    return step if radius is None or length <= radius else step * (radius / length)
