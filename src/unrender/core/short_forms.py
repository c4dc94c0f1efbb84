"""The short text form of components that are functions of a few numbers: "cosine(300)", "warmup(20) then exponential(100)"."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from unrender.core import registry
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean

__all__ = ["parse"]

_CALL = re.compile(r"\s*([A-Za-z_]\w*)\s*(?:\(([^()]*)\))?\s*")
_NEXT = "then"
"""The field that takes what follows the word "then"."""


def parse(text: str, kind: str) -> Any:
    """The component that `text` describes: its name in any case, and the numbers of its first fields in their order.

    Args:
        text: "name", "name(number, ...)", or two of these with "then" between them where the first has a field `then`.
        kind: of `registry.KINDS`.

    Raises:
        InputError: an unknown name, or arguments that do not fit.
    """
    first, *rest = re.split(r"\bthen\b", text, maxsplit=1)
    match = _CALL.fullmatch(first)
    known = {name.lower(): made_by for name, made_by in registry.components(kind).items()}
    name = match[1].lower() if match else ""
    if match is None or name not in known:
        hint = did_you_mean(name, known) or f"; there are {', '.join(known)}"
        raise InputError(f"{kind}: unknown {(match[1] if match else text)!r}{hint}")
    every = [field for field in dataclasses.fields(known[name]) if field.init]
    numbers = [field for field in every if field.name != _NEXT]
    given = [part.strip() for part in match[2].split(",")] if match[2] and match[2].strip() else []
    required = [field.name for field in numbers if field.default is dataclasses.MISSING]
    if not len(required) <= len(given) <= len(numbers):
        raise InputError(f"{kind}: expected {name}({', '.join(field.name for field in numbers)}), got {text!r}")
    arguments: dict[str, Any] = {field.name: _number(part, kind) for field, part in zip(numbers, given, strict=False)}
    if rest:
        if len(numbers) == len(every):
            raise InputError(f'{kind}: only {_with_next(known)} can have something after "then", got {text!r}')
        arguments[_NEXT] = parse(rest[0], kind)
    try:
        return known[name](**arguments)
    except InputError as error:
        raise InputError(f"{kind}: {error}") from error


def _with_next(known: dict[str, type]) -> str:
    names = [name for name, made_by in known.items() if any(each.name == _NEXT for each in dataclasses.fields(made_by))]
    return ", ".join(names)


def _number(text: str, kind: str) -> int | float:
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            pass
    raise InputError(f"{kind}: expected a number, got {text!r}")
