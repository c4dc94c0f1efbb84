"""Elementwise operations on large arrays without large temporaries, and Dr.Jit's memory cache.

Dr.Jit does not return memory to the system: it reuses the memory of a freed array for another of its size. The memory of a process
is therefore set by the largest number of arrays of each size that were alive at once.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import drjit as dr

from unrender.core import arrays
from unrender.core.arrays import Array

LARGE = 1 << 20
"""Number of elements of a large array (4 MB). For smaller arrays, separate kernel launches cost more than they save."""

_PARTS = 16
_ARRAY, _MAPPING, _SEQUENCE = ("array",), ("mapping",), ("sequence",)
"""Contents of values that are no dataclasses, see `_members`."""


def trim_cache(*parts: Any) -> None:
    """Return Dr.Jit's cached memory to the system if a nested structure contains large arrays on a CPU.

    On a CPU, Dr.Jit rounds allocations up to powers of two, and every page that an array has touched stays resident. The call waits for
    the device, so it does nothing on a GPU. The next allocations are a little slower.
    """
    if any(is_large(array) and dr.backend_v(array) == dr.JitBackend.LLVM for array in _flatten(parts)):
        dr.flush_malloc_cache()


def is_large(x: Array) -> bool:
    """Return whether `x` is a Dr.Jit array of at least `LARGE` elements."""
    return arrays.is_drjit(x) and dr.width(arrays.flat(x)) >= LARGE


def evaluate_in_turn(*parts: Any) -> None:
    """Evaluate arrays like `arrays.evaluate`, but large ones one after another, to free intermediate results between them.

    An expression that several large arrays share is computed once for each. Accepts nested lists, tuples, dicts and dataclasses.
    """
    found = _flatten(parts)
    large = [array for array in found if is_large(array)]
    arrays.evaluate([array for array in found if not is_large(array)] if large else found)
    while large:
        array = large.pop(0)
        arrays.evaluate(array)
        if dr.backend_v(array) == dr.JitBackend.LLVM:
            # Memory is free once the kernel that reads it has ended. Waiting for that would stall a GPU.
            dr.sync_thread()


def small_parts(*parts: Any) -> list[Array]:
    """Return the Dr.Jit arrays of a nested structure that are not large, which one launch should compute."""
    return [array for array in _flatten(parts) if not is_large(array)]


def every(x: Array, step: int) -> Array:
    """Return every `step`-th element of a Dr.Jit array, starting at the first, as a one-dimensional array."""
    values = arrays.flat(x)
    kind = dr.uint32_array_t(values)
    return dr.gather(type(values), values, dr.arange(kind, -(-dr.width(values) // step)) * step)


def inner_products(pairs: Sequence[tuple[Array, Array]]) -> list[Array]:
    """Return Σ x y over all elements of each pair (x, y). All arrays have the same shape and type.

    Lazy for Dr.Jit, except that large arrays are evaluated. One kernel multiplies and adds their 16 parts element by element, so that no
    product is stored. (Dr.Jit's `dot` stores no product either. But one thread adds a long sum in single precision, and loses all but a
    few digits.)
    """
    if not pairs or not arrays.is_drjit(pairs[0][0]) or math.prod(pairs[0][0].shape) < LARGE:
        return [arrays.total(x * y) for x, y in pairs]
    parts = []
    for x, y in pairs:
        arrays.evaluate(x, y)
        one, other, kind = arrays.flat(x), arrays.flat(y), dr.uint32_array_t(dr.array_t(x))
        count = dr.width(one)
        size = -(-count // _PARTS)
        index = dr.arange(kind, size)
        sums = dr.zeros(type(one), size)
        for part in range(_PARTS):
            active = index < count - part * size if (part + 1) * size > count else True
            left, right = (dr.gather(type(one), z, index + part * size, active) for z in (one, other))
            sums = sums + left * right
        parts.append(sums)
    arrays.evaluate(parts)
    return [arrays.shaped(dr.sum(part), (), x) for part, (x, _) in zip(parts, pairs, strict=True)]


def square(x: Array) -> Array:
    """Return Σ x² over all elements, computed as in `inner_products`."""
    return inner_products([(x, x)])[0]


def _flatten(parts: Iterable[Any]) -> list[Array]:
    """Return the Dr.Jit arrays of nested structures, in order."""
    found: list[Array] = []
    for value in parts:
        members = _members(type(value))
        if members is _ARRAY:
            found.append(value)
        elif members is _MAPPING:
            found += _flatten(value.values())
        elif members is _SEQUENCE:
            found += _flatten(value)
        elif members:
            found += _flatten([getattr(value, name) for name in members])
    return found


@functools.cache
def _members(kind: type) -> tuple[str, ...]:
    """Return the names of a dataclass's fields, or what values of a type contain; () for nothing. Looked up once for each type."""
    if dr.is_array_v(kind):
        return _ARRAY
    if issubclass(kind, Mapping):
        return _MAPPING
    if issubclass(kind, (list, tuple)):
        return _SEQUENCE
    return tuple(each.name for each in dataclasses.fields(kind)) if dataclasses.is_dataclass(kind) else ()
