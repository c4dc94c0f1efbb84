"""Arithmetic over parameter trees: dictionaries {name: array} of equal keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from unrender.core import arrays

Tree = dict[str, Any]


def map(function: Callable[..., Any], *trees: Tree) -> Tree:
    """Apply `function` to the arrays of equal name."""
    return {name: function(*(tree[name] for tree in trees)) for name in trees[0]}


def add(a: Tree, b: Tree) -> Tree:
    """Return a + b."""
    return map(lambda x, y: x + y, a, b)


def subtract(a: Tree, b: Tree) -> Tree:
    """Return a - b."""
    return map(lambda x, y: x - y, a, b)


def scale(a: Tree, factor: Any) -> Tree:
    """Return factor * a."""
    return map(lambda x: x * factor, a)


def zeros_like(a: Tree) -> Tree:
    """Return zeros of the same shapes."""
    return map(arrays.zeros_like, a)


def shapes(a: Tree) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array."""
    return map(arrays.shape, a)


def all_finite(a: Tree) -> bool:
    """Return whether every element of every array is finite. Waits for the device."""
    return all(arrays.all_finite(x) for x in a.values())


def numpy(a: Tree) -> Tree:
    """Return NumPy copies of the arrays."""
    return map(arrays.numpy, a)
