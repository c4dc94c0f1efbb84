"""Functions that act on NumPy arrays and on Dr.Jit arrays alike.

The formulas of `statistics/`, `losses/` and `optimizers/` use operators and these functions only. They are tested in NumPy against closed
forms, and run unchanged on the device.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import numpy as np

Array = Any
"""A NumPy array, a Dr.Jit array or a Dr.Jit tensor."""


def is_drjit(x: Array) -> bool:
    """Return whether `x` is a Dr.Jit array or tensor, which may be lazy, symbolic or on a GPU."""
    return dr.is_array_v(x)


def to_numpy(x: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array for values of a shape: of a vector such as `mi.Color3f`, which NumPy reads as (3, 1), (3,)."""
    array = np.asarray(x)
    return array[:, 0] if array.shape != shape and array.shape[1:] == (1,) and is_drjit(x) else array


def where(mask: Array, a: Array, b: Array) -> Array:
    """Return `a` where `mask` is true and `b` elsewhere; `a` and `b` may be numbers."""
    return dr.select(mask, a, b) if is_drjit(mask) else np.where(mask, a, b)


def minimum(a: Array, b: Array) -> Array:
    """Return the elementwise minimum."""
    return dr.minimum(a, b) if is_drjit(a) or is_drjit(b) else np.minimum(a, b)


def maximum(a: Array, b: Array) -> Array:
    """Return the elementwise maximum."""
    return dr.maximum(a, b) if is_drjit(a) or is_drjit(b) else np.maximum(a, b)


def clip(x: Array, low: Array, high: Array) -> Array:
    """Clamp each element to [low, high]."""
    return minimum(maximum(x, low), high)


def _either(of_drjit: Callable[[Any], Any], of_numpy: Callable[[Any], Any]) -> Callable[[Array], Array]:
    """Return a function of an array that calls the function of its framework."""
    return lambda x: of_drjit(x) if is_drjit(x) else of_numpy(x)


sqrt = _either(dr.sqrt, np.sqrt)
"""Return the elementwise square root."""
log = _either(dr.log, np.log)
"""Return the elementwise natural logarithm."""
exp = _either(dr.exp, np.exp)
"""Return the elementwise exponential."""
absolute = _either(dr.abs, np.abs)
"""Return the elementwise absolute value."""
is_finite = _either(dr.isfinite, np.isfinite)
"""Return a mask of the elements that are neither infinite nor NaN."""
mean = _either(lambda x: dr.mean(x, axis=None), np.mean)
"""Return the mean over all elements; lazy for Dr.Jit."""
mean_over_first = _either(lambda x: dr.mean(x, axis=0), lambda x: np.mean(x, axis=0))
"""Return the mean over the first axis, (n, ...) -> (...); lazy for Dr.Jit."""
largest = _either(lambda x: dr.max(x, axis=None), np.max)
"""Return the largest element; lazy for Dr.Jit."""
total = _either(lambda x: dr.sum(x, axis=None), np.sum)
"""Return the sum over all elements; lazy for Dr.Jit."""


def sign(x: Array) -> Array:
    """Return -1, 0 or 1 per element. The sign of zero is zero, whereas `drjit.sign` never returns 0."""
    return dr.select(x == 0, 0.0, dr.sign(x)) if is_drjit(x) else np.sign(x)


def all_finite(x: Array) -> bool:
    """Return whether every element is finite. Waits for the device."""
    return bool(np.all(np.isfinite(numpy(x)))) if not is_drjit(x) else bool(dr.all(dr.isfinite(x), axis=None))


def all_true(mask: Array) -> bool:
    """Return whether every element of a mask is true. Waits for the device."""
    return bool(dr.all(mask, axis=None)) if is_drjit(mask) else bool(np.all(mask))


def all_within(x: Array, low: float | None, high: float | None) -> bool:
    """Return whether all elements are in [low, high]; None is open. Waits for the device."""
    return (low is None or all_true(x >= low)) and (high is None or all_true(x <= high))


def zeros_like(x: Array) -> Array:
    """Return zeros of the shape and type of `x`."""
    return dr.zeros(type(x), dr.shape(x)) if is_drjit(x) else np.zeros_like(x)


def shape(x: Array) -> tuple[int, ...]:
    """Return the shape as a tuple of integers."""
    return tuple(x.shape)


def mean_over_rest(x: Array) -> Array:
    """Return the mean over all axes but the first, (n, ...) -> (n,); lazy for Dr.Jit."""
    axes = tuple(range(1, len(x.shape)))
    return dr.mean(x, axis=axes) if is_drjit(x) else np.mean(x, axis=axes)


def add_first_axis(x: Array) -> Array:
    """Prepend an axis of length 1, (...) -> (1, ...)."""
    return type(x)(x.array, (1, *x.shape)) if is_drjit(x) else x[None]


def concatenate(parts: list[Array]) -> Array:
    """Concatenate arrays (n, ...) along their first axis."""
    if len(parts) == 1:
        return parts[0]
    return dr.concat(parts, axis=0) if is_drjit(parts[0]) else np.concatenate(parts)


def scalar(value: float, like: Array) -> Array:
    """Return a number that may change at every step as an opaque value, so that a new value compiles no new kernel."""
    if not is_drjit(like):
        return value
    return dr.opaque(type(like), value, ()) if dr.is_tensor_v(like) else dr.opaque(dr.leaf_t(like), value)


def evaluate(*arrays: Any) -> None:
    """Start the computation of lazy arrays; does nothing for NumPy. Accepts nested lists, tuples and dicts."""
    dr.eval(*arrays)


def numpy(x: Array) -> np.ndarray:
    """Return a NumPy copy of a NumPy or Dr.Jit array. Waits for the device."""
    return np.array(x.numpy() if is_drjit(x) else x)


def view(x: Array) -> np.ndarray:
    """Return the elements as a read-only NumPy view where possible.

    A Dr.Jit array on the CPU shares its memory with the result, which keeps that memory alive. Any other array is copied.
    """
    return x.numpy() if is_drjit(x) else np.array(x)


def owned(values: Array, kind: type) -> Array:
    """Copy values into a one-dimensional Dr.Jit array that owns its memory.

    Dr.Jit borrows NumPy's memory where it can, which has two consequences. Later writes to that memory would change the array, and frozen
    kernels then read stale values or abort (Dr.Jit 1.5). Dr.Jit also compiles a second kernel for memory that is not aligned to 64 bytes,
    and NumPy's alignment is arbitrary. So the values are copied to aligned memory, and one kernel copies them from there.

    Args:
        values: array of any shape, flattened in row-major order.
        kind: Dr.Jit array type of 32-bit elements.
    """
    source = np.ravel(values)
    buffer = np.empty(source.size + 16, np.uint32 if dr.is_integral_v(kind) else np.float32)
    start = -buffer.ctypes.data % 64 // 4
    buffer = buffer[start : start + source.size]
    buffer[:] = source
    copy = kind(buffer) * dr.opaque(kind, 1)
    dr.eval(copy)
    return copy


def like(values: np.ndarray, x: Array) -> Array:
    """Return `values` as an array of the type of `x` that owns its memory."""
    if not is_drjit(x):
        return np.array(values, x.dtype)
    flat = owned(values, dr.array_t(x))
    return type(x)(flat, np.shape(values)) if dr.is_tensor_v(x) else flat


def number(x: Array) -> float:
    """Return an array of one element as a Python float. Waits for the device."""
    return float(numpy(x).reshape(-1)[0]) if is_drjit(x) else float(x)


def like_integers(values: np.ndarray, like: Array) -> Array:
    """Return integers in [0, 2**32) of the index type of arrays such as `like`: `np.uint32` or Dr.Jit's UInt32, which owns its memory."""
    if not is_drjit(like):
        return np.ascontiguousarray(values, np.uint32)
    return owned(values, dr.uint32_array_t(dr.array_t(like)))


def gather_rows(x: Array, index: Array) -> Array:
    """Return the rows `index` (N,) of `x` (P, C), an array (N, C)."""
    if not is_drjit(x):
        return x[index]
    width = x.shape[1]
    kind = type(index)
    element = dr.arange(kind, dr.width(index) * width)
    row = element // width
    flat = dr.gather(dr.array_t(x), x.array, dr.gather(kind, index, row) * width + (element - row * width))
    return type(x)(flat, (dr.width(index), width))


def add_rows(x: Array, index: Array, count: int) -> Array:
    """Add the rows of `x` (N, C) to rows `index` (N,) of a zero array (count, C); the adjoint of `gather_rows`."""
    if not is_drjit(x):
        result = np.zeros((count, x.shape[1]), x.dtype)
        np.add.at(result, index, x)
        return result
    width = x.shape[1]
    kind = type(index)
    element = dr.arange(kind, dr.width(index) * width)
    row = element // width
    flat = dr.zeros(dr.array_t(x), count * width)
    dr.scatter_add(flat, x.array, dr.gather(kind, index, row) * width + (element - row * width))
    return type(x)(flat, (count, width))


def segment_sums(x: Array, starts: Array, numbers: Array) -> Array:
    """Return the sums of consecutive rows of `x` (N, C) for P segments, (P, C), by their first rows, ascending, and numbers of rows, >= 1.
    Each row is in one segment. The order of summation is fixed."""
    if not is_drjit(x):
        return np.add.reduceat(x, starts, axis=0)
    width, kind, values = x.shape[1], type(starts), x.array
    dr.eval(values)
    element = dr.arange(kind, dr.width(starts) * width)
    row = element // width
    first, count = dr.gather(kind, starts, row) * width + (element - row * width), dr.gather(kind, numbers, row)

    def add(k: Array, sums: Array) -> tuple[Array, Array]:
        return k + 1, sums + dr.gather(dr.array_t(x), values, first + k * width)

    empty: Any = dr.zeros(kind, dr.width(element)), dr.zeros(dr.array_t(x), dr.width(element))
    loop: Any = dr.while_loop
    _, sums = loop(empty, lambda k, sums: k < count, add)
    return type(x)(sums, (dr.width(starts), width))


def sum_over_last(x: Array) -> Array:
    """Sum over the last axis, which keeps length 1: (..., C) -> (..., 1); lazy for Dr.Jit."""
    if not is_drjit(x):
        return x.sum(axis=-1, keepdims=True)
    return reshape(dr.sum(x, axis=-1), (*x.shape[:-1], 1))


def sum_over_rows(x: Array) -> Array:
    """Sum over all axes but the last, (..., C) -> (1, C); lazy for Dr.Jit."""
    if not is_drjit(x):
        return x.reshape(-1, x.shape[-1]).sum(axis=0)[None]
    width, count = x.shape[-1], len(x.array)
    kind = dr.uint32_array_t(dr.array_t(x))
    # One sum per channel, of values gathered into a contiguous array: such a sum has a fixed order.
    sums = [
        dr.sum(dr.gather(dr.array_t(x), x.array, dr.arange(kind, count // width) * width + c)) for c in range(width)
    ]
    return type(x)(dr.concat(sums), (1, width))


def gather(x: Array, index: Array) -> Array:
    """Return the elements `index` of a one-dimensional array."""
    return dr.gather(type(x), x, index) if is_drjit(x) else x[index]


def searchsorted(ascending: Array, values: Array) -> Array:
    """Return the index of the last element of `ascending` that is <= each value. All are unsigned integers.

    The first element of `ascending` must be <= every value.
    """
    if not is_drjit(ascending):
        return (np.searchsorted(ascending, values, side="right") - 1).astype(np.uint32)
    kind = type(values)
    end = dr.binary_search(0, dr.width(ascending), lambda index: dr.gather(kind, ascending, index) <= values)
    return kind(end) - 1


def arange(like: Array, count: int) -> Array:
    """Return the integers 0 ... count - 1 of the index type of arrays such as `like`."""
    return (
        dr.arange(dr.uint32_array_t(dr.array_t(like)), count) if is_drjit(like) else np.arange(count, dtype=np.uint32)
    )


def integer(value: int, like: Array) -> Array:
    """Return an integer in [0, 2**32) that may change at every step as an opaque value, so that a new value compiles no new kernel."""
    return dr.opaque(dr.uint32_array_t(dr.array_t(like)), value) if is_drjit(like) else np.uint32(value)


def random_integers(like: Array, seed: int, count: int, below: int) -> Array:
    """Return `count` integers, uniform in [0, below), of the index type of arrays such as `like`."""
    if not is_drjit(like):
        return np.random.default_rng(seed).integers(below, size=count, dtype=np.uint32)
    return dr.rng(seed).integers(dr.uint32_array_t(dr.array_t(like)), count, 0, below)


def random_below(bounds: Array, like: Array, seed: int) -> Array:
    """Return an integer uniform in [0, bound) for each of `bounds` (N,), unsigned integers >= 1.

    On Dr.Jit the number comes from a float32 in [0, 1), so its distribution is uniform to about bound / 2**24.
    """
    if not is_drjit(like):
        return np.random.default_rng(seed).integers(bounds, dtype=np.uint32)
    kind = type(bounds)
    number = dr.rng(seed).random(dr.array_t(like), dr.width(bounds))
    return dr.minimum(kind(number * bounds), bounds - 1)


def sum_in_double(parts: Sequence[Array]) -> Array:
    """Sum arrays of equal shapes in order, in double precision; the sum is rounded once to their type. Lazy for Dr.Jit."""
    first = parts[0]
    if len(parts) == 1:
        return first
    wide: Any = dr.float64_array_t(type(first)) if is_drjit(first) else np.float64
    result = wide(first)
    for part in parts[1:]:
        result = result + wide(part)
    return type(first)(result) if is_drjit(first) else result.astype(first.dtype)


def rows(x: Array) -> Array:
    """Flatten all axes but the last, (..., C) -> (N, C)."""
    width = x.shape[-1]
    return type(x)(x.array, (len(x.array) // width, width)) if is_drjit(x) else x.reshape(-1, width)


def reshape(x: Array, shape: tuple[int, ...]) -> Array:
    """Return the same elements in another shape."""
    return dr.reshape(x, shape) if is_drjit(x) else x.reshape(shape)


def flat(x: Array) -> Array:
    """Return the elements in row-major order as a one-dimensional array; for a Dr.Jit tensor, its underlying array."""
    return (x.array if dr.is_tensor_v(x) else x) if is_drjit(x) else x.reshape(-1)


def shaped(x: Array, shape: tuple[int, ...], like: Array) -> Array:
    """Reshape a one-dimensional array to `shape` and the type of `like`; the inverse of `flat`."""
    if not is_drjit(like):
        return x.reshape(shape)
    return type(like)(x, shape) if dr.is_tensor_v(like) else x
