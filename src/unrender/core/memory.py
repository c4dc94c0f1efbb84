"""Elementwise work on large arrays without temporaries of their size, and the memory that Dr.Jit keeps.

Dr.Jit frees nothing: memory of an array that dies waits for another of its size. So what a process takes is not what it holds but the most
that it has ever held, of each size: what counts is how many arrays are alive at the worst instant.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import drjit as dr

from unrender.core import arrays
from unrender.core.arrays import Array

LARGE = 1 << 20
"""Elements from which on an array is large: 4 MB. Of smaller ones the launches would cost more than the memory is worth."""

_PARTS = 16


def trim_cache(*parts: Any) -> None:
    """Give the system back what Dr.Jit keeps for arrays to come, where there are large ones in a nested structure, on a CPU.

    There memory is handed out by powers of two, and as much of a piece as any array has ever used stays in the process. It waits for the
    device, which would stall a GPU, and arrays after that take a little longer to make.
    """
    if any(is_large(array) and dr.backend_v(array) == dr.JitBackend.LLVM for array in _arrays(parts)):
        dr.flush_malloc_cache()


def is_large(x: Array) -> bool:
    """Whether `x` is a Dr.Jit array of many elements."""
    return arrays.is_drjit(x) and dr.width(arrays.flat(x)) >= LARGE


def evaluate_in_turn(*parts: Any) -> None:
    """As `arrays.evaluate`, large arrays one after the other: what only the earlier ones are computed from is freed before the next.

    An expression that several arrays share is computed for each. Accepts nested lists, tuples, dicts and dataclasses.
    """
    arrays.evaluate(small_parts(*parts))
    large = [array for array in _arrays(parts) if is_large(array)]
    while large:
        array = large.pop(0)
        arrays.evaluate(array)
        if dr.backend_v(array) == dr.JitBackend.LLVM:
            # There memory is free once the kernel that reads it has ended; on a GPU to wait would stall it.
            dr.sync_thread()


def small_parts(*parts: Any) -> list[Array]:
    """The arrays in a nested structure that are not large: what one launch should compute."""
    return [array for array in _arrays(parts) if not is_large(array)]


def every(x: Array, step: int) -> Array:
    """Each `step`-th element of a Dr.Jit array, from the first on, flat."""
    values = arrays.flat(x)
    kind = dr.uint32_array_t(values)
    return dr.gather(type(values), values, dr.arange(kind, -(-dr.width(values) // step)) * step)


def inner_products(pairs: Sequence[tuple[Array, Array]]) -> list[Array]:
    """Σ x y over all elements of each pair (x, y) of equal shapes and kinds, left lazy on Dr.Jit.

    Of long arrays 16 parts are summed element by element first, all pairs by one kernel, lest each product is stored. (Dr.Jit's own `dot`
    stores none either, but rounds a long sum of one thread to a few digits.)
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
        found = dr.zeros(type(one), size)
        for part in range(_PARTS):
            within = index < count - part * size if (part + 1) * size > count else True
            left, right = (dr.gather(type(one), z, index + part * size, within) for z in (one, other))
            found = found + left * right
        parts.append(found)
    arrays.evaluate(parts)
    return [arrays.shaped(dr.sum(part), (), x) for part, (x, _) in zip(parts, pairs, strict=True)]


def square(x: Array) -> Array:
    """Σ x² over all elements, likewise."""
    return inner_products([(x, x)])[0]


def _arrays(value: Any) -> Iterator[Array]:
    """The Dr.Jit arrays in a nested structure."""
    if arrays.is_drjit(value):
        yield value
    elif isinstance(value, Mapping):
        yield from _of_all(value.values())
    elif isinstance(value, (list, tuple)):
        yield from _of_all(value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield from _of_all(getattr(value, each.name) for each in dataclasses.fields(value))


def _of_all(values: Iterable[Any]) -> Iterator[Array]:
    for value in values:
        yield from _arrays(value)
