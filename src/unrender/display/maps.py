"""Which parameters are shown as pictures, and the planes of them that are."""

from __future__ import annotations

import numpy as np

__all__ = ["is_map", "plane", "planes"]

_VALUES_IN_A_TABLE = 16


def is_map(array: np.ndarray) -> bool:
    """Whether a parameter is shown as a picture: textures (H, W), (H, W, 1 | 3 | 4), volumes (Z, Y, X, 1 | 3 | 4)."""
    if array.size == 0:
        return False
    if array.ndim == 2:
        return array.size > _VALUES_IN_A_TABLE and min(array.shape) > 1
    return array.ndim in (3, 4) and array.shape[-1] in (1, 3, 4) and sum(n > 1 for n in array.shape[:-1]) >= 2


def plane(array: np.ndarray) -> np.ndarray | None:
    """(H, W, C) of a map: the texture itself or a volume's first middle slice; None for what is no map."""
    return next(iter(planes(array).values()), None)


def planes(array: np.ndarray | None) -> dict[str, np.ndarray]:
    """{label: (H, W, C)}: the texture itself, or a volume's middle slices along its axes."""
    if array is None or not is_map(array):
        return {}
    if array.ndim == 2:
        return {"": array[..., None]}
    if array.ndim == 3:
        return {"": array}
    found = {}
    for axis, name in enumerate("zyx"):
        plane = np.take(array, array.shape[axis] // 2, axis=axis)
        if min(plane.shape[:2]) > 1:
            found[f"middle slice along {name}"] = plane
    return found or {"slice": array.reshape(-1, *array.shape[2:])}
