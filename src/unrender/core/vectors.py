"""Parameter trees as one vector on the host, for optimizers that treat all parameters jointly."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from unrender.core import arrays
from unrender.core.trees import Tree


def ravel(tree: Tree) -> np.ndarray:
    """All elements in key order, (n,), double precision. Waits for the device."""
    return np.concatenate([arrays.numpy(x).ravel().astype(np.float64) for x in tree.values()])


def parts(vectors: np.ndarray, like: Tree) -> dict[str, np.ndarray]:
    """{key: (..., *shape)} of the shapes of `like`, from (..., n)."""
    found, start = {}, 0
    for key, x in like.items():
        shape = arrays.shape(x)
        size = math.prod(shape)
        found[key] = vectors[..., start : start + size].reshape((*vectors.shape[:-1], *shape))
        start += size
    return found


def unravel(vector: np.ndarray, like: Tree) -> Tree:
    """The tree of the shapes and types of `like` with these elements, in memory of its own; the inverse of `ravel`."""
    found = {}
    for key, part in parts(vector, like).items():
        x = like[key]
        if arrays.is_drjit(x):  # the sum leaves NumPy's memory, see `MitsubaRenderer.array`
            found[key] = type(x)(part.astype(np.float32)) + arrays.scalar(0.0, x)
        else:
            found[key] = part.astype(x.dtype)
    return found


def repeat_per_element(numbers: Mapping[str, float | np.ndarray], like: Tree) -> np.ndarray:
    """One number per parameter, repeated for its elements, or one for each element, (n,)."""
    return np.concatenate(
        [np.broadcast_to(np.asarray(numbers[key], float), arrays.shape(x)).ravel() for key, x in like.items()]
    )


def clip_norm(step: np.ndarray, radius: float | None) -> np.ndarray:
    """`step`, shortened to the length `radius` where it is longer; None for no limit."""
    length = float(np.linalg.norm(step))
    return step if radius is None or length <= radius else step * (radius / length)
