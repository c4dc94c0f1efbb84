"""Texts such as `strength * [1, 0.8, 0.6]` as functions of unknowns. No text runs any other code."""

from __future__ import annotations

import ast
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from unrender.core import arrays, checks
from unrender.core.errors import KeyedError
from unrender.core.text import did_you_mean

Function = Callable[[Any], Any]
"""A function of values by name; see `Expression`."""

_FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "abs": (1, dr.abs),
    "cos": (1, dr.cos),
    "exp": (1, dr.exp),
    "log": (1, dr.log),
    "max": (2, dr.maximum),
    "min": (2, dr.minimum),
    "mix": (3, lambda a, b, t: a + (b - a) * t),
    "sin": (1, dr.sin),
    "sqrt": (1, dr.sqrt),
    "tanh": (1, dr.tanh),
}
"""Functions of the text form, with the number of their arguments."""


def _power(a: Any, b: Any) -> Any:
    """Return a ** b. Dr.Jit has NaN for 0 ** 0, which is 1, and 0 for the derivative by a at 0 where b is at most 1: infinity or 1."""
    if isinstance(b, float) and not 0.0 < b < 1.0:
        return a**b
    a = a if isinstance(a, float) and a != 0.0 else dr.select((a == 0.0) & (b == 0.0), 1.0, a)
    root, line = (a == 0.0) & (b > 0.0) & (b < 1.0), (a == 0.0) & (b == 1.0)
    return dr.select(root, dr.sqrt(dr.select(root, a, 1.0)), dr.select(line, a, a**b))


_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: _power,
}
_LONGEST, _DEEPEST = 1000, 50  # characters and nesting of a text form


def parse(key: str, text: str) -> Function:
    """Return the function that a text describes.

    The text has numbers, lists of numbers, names of unknowns, + - * / **, parentheses, name[i] for the i-th row, and the functions abs,
    cos, exp, log, max, min, mix(a, b, t), sin, sqrt and tanh. Raises `KeyedError` for anything else.
    """
    try:
        if len(text) > _LONGEST:
            raise KeyedError(key, f"longer than {_LONGEST} characters")
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise KeyedError(key, f"it is no expression: {text!r:.60}") from error
    return _compiled(key, tree, 0)


def _row(key: str, name: str, value: Any, index: int) -> Any:
    """Return a row of a value. Raises `KeyedError` if there is none of this index."""
    rows = arrays.shape(value)[0]
    if index >= rows:
        raise KeyedError(
            key, f"{name}[{index}] is not there: {name} has {rows} row{'s' * (rows > 1)}, the first is {name}[0]"
        )
    return value[index]


def _compiled(key: str, node: ast.expr, depth: int) -> Function:
    """Return the function of one node of a syntax tree. Raises `KeyedError` for a node of another kind."""
    if depth > _DEEPEST:
        raise KeyedError(key, f"nested more than {_DEEPEST} times")

    def inner(part: ast.expr) -> Function:
        return _compiled(key, part, depth + 1)

    match node:
        case ast.Constant(value=value) if isinstance(value, (int, float)) and not isinstance(value, bool):
            number = checks.real(value)
            return lambda _: number
        case ast.Name(id=name):
            return lambda values: values[name]
        case ast.List():
            try:
                table = np.array(ast.literal_eval(node), np.float32)
            except (ValueError, TypeError, OverflowError) as error:
                raise KeyedError(key, "a list must have numbers, in rows of one length") from error
            return lambda values: arrays.like(table, values.like)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            value = inner(operand)
            return lambda values: -value(values)
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
            apply, (a, b) = _OPERATORS[type(operator)], (inner(left), inner(right))
            return lambda values: apply(a(values), b(values))
        case ast.Subscript(value=ast.Name(id=name), slice=ast.Constant(value=index)) if isinstance(index, int):
            return lambda values: _row(key, name, values[name], index)
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in _FUNCTIONS:
            count, function = _FUNCTIONS[name]
            if len(args) != count:
                raise KeyedError(key, f"{name} takes {count} arguments, got {len(args)}")
            parts = [inner(part) for part in args]
            return lambda values: function(*(part(values) for part in parts))
    hint = "; a power is **" if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor) else ""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id not in _FUNCTIONS:
        hint = did_you_mean(node.func.id, _FUNCTIONS)
    allowed = f"numbers, lists, unknowns, + - * / **, name[0], {', '.join(_FUNCTIONS)}{hint}"
    raise KeyedError(key, f"{ast.unparse(node)!r:.60} is not allowed; there are {allowed}")
