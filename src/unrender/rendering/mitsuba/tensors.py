"""Conversion of Mitsuba values to tensors: a number is (), a colour (3,), a bitmap (H, W, C), a grid (Z, Y, X, C)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core import arrays


def tensor(values: np.ndarray) -> mi.TensorXf:
    """Return a tensor of these values in its own memory."""
    return mi.TensorXf(arrays.owned(values, mi.Float), np.shape(values))


def native_shape(value: Any) -> tuple[int, ...]:
    """Return the shape of the tensor for a Mitsuba value. Raise `TypeError` for a value that is not an array."""
    if isinstance(value, (int, float)):
        return ()
    if not dr.is_array_v(value) or dr.is_matrix_v(value) or dr.is_special_v(value):
        raise TypeError(type(value).__name__)
    if dr.is_tensor_v(value):
        return tuple(value.shape)
    if dr.depth_v(value) == 1:
        return () if len(value) == 1 else (len(value),)
    if dr.depth_v(value) == 2 and dr.width(value) == 1:
        return (len(value),)
    raise TypeError(type(value).__name__)


def to_tensor(value: Any) -> mi.TensorXf:
    """Return the tensor (`mi.TensorXf`, detached) for a Mitsuba value."""
    shape = native_shape(value)
    if isinstance(value, (int, float)):
        return mi.TensorXf(np.float32(value))  # pyright: ignore[reportArgumentType]
    if dr.is_tensor_v(value):
        return mi.TensorXf(dr.detach(value))
    return mi.TensorXf(dr.ravel(dr.detach(value)), shape)  # pyright: ignore[reportArgumentType]


def from_tensor(tensor: mi.TensorXf, like: Any) -> Any:
    """Return the Mitsuba value of the type of `like` for a tensor; the inverse of `to_tensor`."""
    if dr.is_tensor_v(like):
        return type(like)(tensor.array, tuple(tensor.shape))
    if dr.depth_v(like) == 1:
        return type(like)(tensor.array)
    return dr.unravel(type(like), type(like[0])(tensor.array))


def is_broadcast(values: np.ndarray) -> bool:
    """Return whether an array has one state, or repeats one along its first axis without copies (`numpy.broadcast_to`).

    Values are not compared. See `RenderSession.image_batch`.
    """
    return len(values) == 1 or np.asarray(values).strides[0] == 0
