"""Arithmetic over parameter trees: dictionaries {name: array} of equal keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from unrender.core import arrays

Tree = dict[str, Any]


def map(function: Callable[..., Any], *trees: Tree) -> Tree:
    """`function` applied to the arrays of equal name."""
    return {name: function(*(tree[name] for tree in trees)) for name in trees[0]}


def add(a: Tree, b: Tree) -> Tree:
    """a + b."""
    return map(lambda x, y: x + y, a, b)


def subtract(a: Tree, b: Tree) -> Tree:
    """a - b."""
    return map(lambda x, y: x - y, a, b)


def scale(a: Tree, factor: Any) -> Tree:
    """factor * a."""
    return map(lambda x: x * factor, a)


def zeros_like(a: Tree) -> Tree:
    """Zeros of the same shapes."""
    return map(arrays.zeros_like, a)


def shapes(a: Tree) -> dict[str, tuple[int, ...]]:
    """The shape of each array."""
    return map(arrays.shape, a)


def all_finite(a: Tree) -> bool:
    """Whether every element of every array is finite. Waits for the device."""
    return all(arrays.all_finite(x) for x in a.values())


def numpy(a: Tree) -> Tree:
    """NumPy copies."""
    return map(arrays.numpy, a)
