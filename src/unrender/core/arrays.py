"""Array functions beyond operators, for NumPy arrays and Dr.Jit arrays alike.

Every formula of `statistics/`, `losses/` and `optimizers/` uses operators and these functions only, so that it is tested in NumPy
against closed forms and runs unchanged on the device.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np

Array = Any
"""A NumPy array, or a Dr.Jit array or tensor."""


def is_drjit(x: Array) -> bool:
    """Whether `x` is a Dr.Jit array (and so may be lazy, symbolic, on a GPU)."""
    return dr.is_array_v(x)


def where(mask: Array, a: Array, b: Array) -> Array:
    """`a` where `mask` holds, else `b`; either may be a number."""
    return dr.select(mask, a, b) if is_drjit(mask) else np.where(mask, a, b)


def minimum(a: Array, b: Array) -> Array:
    """The smaller, per element."""
    return dr.minimum(a, b) if is_drjit(a) or is_drjit(b) else np.minimum(a, b)


def maximum(a: Array, b: Array) -> Array:
    """The larger, per element."""
    return dr.maximum(a, b) if is_drjit(a) or is_drjit(b) else np.maximum(a, b)


def clip(x: Array, low: Array, high: Array) -> Array:
    """`x` clamped to [low, high]."""
    return minimum(maximum(x, low), high)


def sqrt(x: Array) -> Array:
    """The square root, per element."""
    return dr.sqrt(x) if is_drjit(x) else np.sqrt(x)


def log(x: Array) -> Array:
    """The natural logarithm, per element."""
    return dr.log(x) if is_drjit(x) else np.log(x)


def exp(x: Array) -> Array:
    """e to the power of each element."""
    return dr.exp(x) if is_drjit(x) else np.exp(x)


def absolute(x: Array) -> Array:
    """The magnitude, per element."""
    return dr.abs(x) if is_drjit(x) else np.abs(x)


def sign(x: Array) -> Array:
    """-1, 0 or 1 per element. Zero at zero, unlike `drjit.sign`, which never returns 0."""
    return dr.select(x == 0, 0.0, dr.sign(x)) if is_drjit(x) else np.sign(x)


def is_finite(x: Array) -> Array:
    """A mask: neither infinite nor NaN."""
    return dr.isfinite(x) if is_drjit(x) else np.isfinite(x)


def all_finite(x: Array) -> bool:
    """Whether every element is finite. Waits for the device."""
    return bool(np.all(np.isfinite(numpy(x)))) if not is_drjit(x) else bool(dr.all(dr.isfinite(x), axis=None))


def all_true(mask: Array) -> bool:
    """Whether every element of a mask holds. Waits for the device."""
    return bool(dr.all(mask, axis=None)) if is_drjit(mask) else bool(np.all(mask))


def zeros_like(x: Array) -> Array:
    """Zeros of the shape and kind of `x`."""
    return dr.zeros(type(x), dr.shape(x)) if is_drjit(x) else np.zeros_like(x)


def shape(x: Array) -> tuple[int, ...]:
    """The shape as a tuple of integers."""
    return tuple(x.shape)


def mean(x: Array) -> Array:
    """The mean over all elements, left lazy on Dr.Jit."""
    return dr.mean(x, axis=None) if is_drjit(x) else np.mean(x)


def mean_over_first(x: Array) -> Array:
    """The mean over the first axis, (n, ...) -> (...), left lazy on Dr.Jit."""
    return dr.mean(x, axis=0) if is_drjit(x) else np.mean(x, axis=0)


def mean_over_rest(x: Array) -> Array:
    """The mean over all axes but the first, (n, ...) -> (n,), left lazy on Dr.Jit."""
    axes = tuple(range(1, len(x.shape)))
    return dr.mean(x, axis=axes) if is_drjit(x) else np.mean(x, axis=axes)


def add_first_axis(x: Array) -> Array:
    """`x` with a first axis of length 1, (...) -> (1, ...)."""
    return type(x)(x.array, (1, *x.shape)) if is_drjit(x) else x[None]


def concatenate(parts: list[Array]) -> Array:
    """Arrays (n, ...) concatenated along their first axis."""
    if len(parts) == 1:
        return parts[0]
    return dr.concat(parts, axis=0) if is_drjit(parts[0]) else np.concatenate(parts)


def largest(x: Array) -> Array:
    """The largest element, left lazy on Dr.Jit."""
    return dr.max(x, axis=None) if is_drjit(x) else np.max(x)


def total(x: Array) -> Array:
    """The sum over all elements, left lazy on Dr.Jit."""
    return dr.sum(x, axis=None) if is_drjit(x) else np.sum(x)


def scalar(value: float, like: Array) -> Array:
    """A number that changes from step to step, in a form that does not compile a new kernel each time."""
    if not is_drjit(like):
        return value
    return dr.opaque(type(like), value, ()) if dr.is_tensor_v(like) else dr.opaque(dr.leaf_t(like), value)


def evaluate(*arrays: Any) -> None:
    """Start the computation of lazy arrays (no effect on NumPy). Accepts nested lists, tuples and dicts."""
    dr.eval(*arrays)


def numpy(x: Array) -> np.ndarray:
    """A NumPy copy, whatever `x` was."""
    return np.array(x.numpy() if is_drjit(x) else x)


def view(x: Array) -> np.ndarray:
    """The elements as NumPy sees them, not to be written to: on a CPU the memory of a Dr.Jit array itself, which then lives as long; else a
    copy."""
    return x.numpy() if is_drjit(x) else np.array(x)


def owned(values: Array, kind: type) -> Array:
    """A one-dimensional Dr.Jit array of type `kind` (32 bits an element) with the elements of `values`, in memory of its own.

    Dr.Jit borrows NumPy's memory where it can. Later writes to it would change the array, frozen kernels read stale texels or abort
    (Dr.Jit 1.5), and kernels are compiled once for memory aligned to 64 bytes and once more for any other, which in NumPy is
    chance. So the elements are copied to aligned memory, and from there by one and the same kernel.
    """
    given = np.ravel(values)
    room = np.empty(given.size + 16, np.uint32 if dr.is_integral_v(kind) else np.float32)
    start = -room.ctypes.data % 64 // 4
    room = room[start : start + given.size]
    room[:] = given
    copy = kind(room) * dr.opaque(kind, 1)
    dr.eval(copy)
    return copy


def like(values: np.ndarray, x: Array) -> Array:
    """`values` as an array of the kind of `x`, in memory of its own."""
    if not is_drjit(x):
        return np.array(values, x.dtype)
    flat = owned(values, dr.array_t(x))
    return type(x)(flat, np.shape(values)) if dr.is_tensor_v(x) else flat


def number(x: Array) -> float:
    """A Python float from an array of one element. Waits for the device."""
    return float(numpy(x).reshape(-1)[0]) if is_drjit(x) else float(x)


def like_integers(values: np.ndarray, like: Array) -> Array:
    """Integers in [0, 2**32) of the type that indexes arrays such as `like`: `np.uint32`, or Dr.Jit's UInt32 in memory of its own."""
    if not is_drjit(like):
        return np.ascontiguousarray(values, np.uint32)
    return owned(values, dr.uint32_array_t(dr.array_t(like)))


def gather_rows(x: Array, index: Array) -> Array:
    """The rows `index` (N,) of `x` (P, C): (N, C)."""
    if not is_drjit(x):
        return x[index]
    width = x.shape[1]
    kind = type(index)
    element = dr.arange(kind, dr.width(index) * width)
    row = element // width
    flat = dr.gather(dr.array_t(x), x.array, dr.gather(kind, index, row) * width + (element - row * width))
    return type(x)(flat, (dr.width(index), width))


def add_rows(x: Array, index: Array, count: int) -> Array:
    """The inverse of `gather_rows`: rows of `x` (N, C) are added to the rows `index` (N,) of zeros, (count, C)."""
    if not is_drjit(x):
        found = np.zeros((count, x.shape[1]), x.dtype)
        np.add.at(found, index, x)
        return found
    width = x.shape[1]
    kind = type(index)
    element = dr.arange(kind, dr.width(index) * width)
    row = element // width
    flat = dr.zeros(dr.array_t(x), count * width)
    dr.scatter_add(flat, x.array, dr.gather(kind, index, row) * width + (element - row * width))
    return type(x)(flat, (count, width))


def segment_sums(x: Array, starts: Array, numbers: Array) -> Array:
    """Sums of runs of consecutive rows of `x` (N, C), in a fixed order: (P, C).

    Args:
        x: of which every row is in one run.
        starts: the first row of each run, (P,), ascending integers.
        numbers: of rows in each, (P,), >= 1.
    """
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
    """The sum over the last axis, which stays with length 1: (..., C) -> (..., 1), left lazy on Dr.Jit."""
    if not is_drjit(x):
        return x.sum(axis=-1, keepdims=True)
    return reshape(dr.sum(x, axis=-1), (*x.shape[:-1], 1))


def sum_over_rows(x: Array) -> Array:
    """The sum over all axes but the last, (..., C) -> (1, C), left lazy on Dr.Jit."""
    if not is_drjit(x):
        return x.reshape(-1, x.shape[-1]).sum(axis=0)[None]
    width, count = x.shape[-1], len(x.array)
    kind = dr.uint32_array_t(dr.array_t(x))
    # Element by element along a channel: a sum of contiguous values has a fixed order.
    sums = [
        dr.sum(dr.gather(dr.array_t(x), x.array, dr.arange(kind, count // width) * width + c)) for c in range(width)
    ]
    return type(x)(dr.concat(sums), (1, width))


def gather(x: Array, index: Array) -> Array:
    """The elements `index` of a one-dimensional array."""
    return dr.gather(type(x), x, index) if is_drjit(x) else x[index]


def searchsorted(ascending: Array, values: Array) -> Array:
    """For each value, the index of the last element of `ascending` that is at most the value; the first element must be."""
    if not is_drjit(ascending):
        return (np.searchsorted(ascending, values, side="right") - 1).astype(np.uint32)
    kind = type(values)
    found = dr.binary_search(0, dr.width(ascending), lambda index: dr.gather(kind, ascending, index) <= values)
    return kind(found) - 1


def arange(like: Array, count: int) -> Array:
    """0, 1, 2, ..., integers of the type that indexes arrays such as `like`."""
    return (
        dr.arange(dr.uint32_array_t(dr.array_t(like)), count) if is_drjit(like) else np.arange(count, dtype=np.uint32)
    )


def integer(value: int, like: Array) -> Array:
    """An integer in [0, 2**32) that changes from step to step, in a form that does not compile a new kernel each time."""
    return dr.opaque(dr.uint32_array_t(dr.array_t(like)), value) if is_drjit(like) else np.uint32(value)


def random_integers(like: Array, seed: int, count: int, below: int) -> Array:
    """`count` integers, uniform in [0, below)."""
    if not is_drjit(like):
        return np.random.default_rng(seed).integers(below, size=count, dtype=np.uint32)
    return dr.rng(seed).integers(dr.uint32_array_t(dr.array_t(like)), count, 0, below)


def random_below(bounds: Array, like: Array, seed: int) -> Array:
    """For each bound, an integer uniform in [0, bound)."""
    if not is_drjit(like):
        return np.random.default_rng(seed).integers(bounds, dtype=np.uint32)
    kind = type(bounds)
    number = dr.rng(seed).random(dr.array_t(like), dr.width(bounds))
    return dr.minimum(kind(number * bounds), bounds - 1)


def sum_in_double(parts: Sequence[Array]) -> Array:
    """The sum of arrays of equal shapes in their order, in double precision, rounded to theirs once; lazy on Dr.Jit."""
    first = parts[0]
    if len(parts) == 1:
        return first
    wide: Any = dr.float64_array_t(type(first)) if is_drjit(first) else np.float64
    found = wide(first)
    for part in parts[1:]:
        found = found + wide(part)
    return type(first)(found) if is_drjit(first) else found.astype(first.dtype)


def rows(x: Array) -> Array:
    """(..., C) to (N, C)."""
    width = x.shape[-1]
    return type(x)(x.array, (len(x.array) // width, width)) if is_drjit(x) else x.reshape(-1, width)


def reshape(x: Array, shape: tuple[int, ...]) -> Array:
    """The same elements in another shape."""
    return dr.reshape(x, shape) if is_drjit(x) else x.reshape(shape)


def flat(x: Array) -> Array:
    """The elements in row-major order, one-dimensional: of a Dr.Jit tensor, its array."""
    return (x.array if dr.is_tensor_v(x) else x) if is_drjit(x) else x.reshape(-1)


def shaped(x: Array, shape: tuple[int, ...], like: Array) -> Array:
    """The inverse of `flat`: one-dimensional `x` in a shape, of the kind of `like`."""
    if not is_drjit(like):
        return x.reshape(shape)
    return type(like)(x, shape) if dr.is_tensor_v(like) else x
