"""Options of a method that have no effect, because of other options or because of the problem, and measurements that plans share."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import pydantic
from pydantic import BaseModel

from unrender.core.errors import InputError

Decide = Callable[[Any], Any]
"""Function that returns what options decide, an object that `repr` shows in full. Raises `InputError` for incompatible options."""


Measured = TypeVar("Measured")
_measured: ContextVar[dict[Hashable, tuple[Any, Any]] | None] = ContextVar("measured", default=None)

_NUMBER = re.compile(r"\d+(\.\d*)?(e[-+]?\d+)?")


@contextmanager
def measuring_once() -> Iterator[None]:
    """Render for equal plans once: `measure` keeps its results within this block."""
    before = _measured.set({})
    try:
        yield
    finally:
        _measured.reset(before)


def measure(problem: Any, key: tuple[Hashable, ...], function: Callable[[], Measured]) -> Measured:
    """Return a result that renders of a problem and `key` decide alone, within `measuring_once` the one of an equal call."""
    known = _measured.get()
    if known is None:
        return function()
    name = (id(problem), *key)
    if name not in known:
        known[name] = problem, function()  # with the problem, so that its id stays its own
    return known[name][1]


def check(options: BaseModel, name: str, decide: Decide, decided: Any) -> None:
    """Raise `InputError` for an option without effect, and say which other options it needs. `decided` is what the options decide."""
    if has_effect(options, name, decide, decided):
        return
    needed, beside = [], []
    for other in type(options).model_fields:
        for value in choices(options, other) if other != name else ():
            changed = _changed(options, other, value)
            if changed is None or isinstance(then := _outcome(changed, decide), InputError):
                continue
            if has_effect(changed, name, decide, then):
                needed.append(f"{other}={_text(value)}")
                beside.append(f"{other}={_text(getattr(options, other))}")
    if needed:
        present = " and ".join(dict.fromkeys(beside))
        raise InputError(f"option {name} has no effect with {present}; it needs {' or '.join(needed)}")
    raise InputError(f"option {name} has no effect with these options on this problem; leave it out")


def has_effect(options: BaseModel, name: str, decide: Decide, decided: Any) -> bool:
    """Return whether an option has its default, or another value of it would decide something else.

    Another value than the default counts, because the option may ask for what the method would choose anyway. Options of registered methods
    always count, because `repr` of their parts may not show them.
    """
    ours = type(options).__module__.startswith("unrender.")
    if not ours or getattr(options, name) == type(options).model_fields[name].default:
        return True
    return any(repr(_outcome(other, decide)) != repr(decided) for other in _others(options, name))


def _others(options: BaseModel, name: str) -> Iterator[BaseModel]:
    """Yield the options with other values of one of them: its default, its other choices, or other numbers."""
    own = getattr(options, name)
    numbers: list[Any] = []
    if isinstance(own, str):
        numbers = [_NUMBER.sub(lambda found: f"{2.0 * float(found[0]):g}", own)]
    elif isinstance(own, (int, float)) and not isinstance(own, bool):
        numbers = [2 * own, own / 2, own + 1]
    for value in [type(options).model_fields[name].default, *choices(options, name), *numbers]:
        if value != own and (changed := _changed(options, name, value)) is not None:
            yield changed


def choices(options: BaseModel, name: str) -> list[Any]:
    """Return the other values of an option with a few values; [] for numbers and texts."""
    schema, own = type(options).model_json_schema()["properties"][name], getattr(options, name)
    kinds = schema.get("anyOf", [schema])
    values = [value for kind in kinds for value in (kind.get("enum") or _booleans(kind))]
    return [value for value in values if value != own]


def _booleans(kind: dict[str, Any]) -> list[bool]:
    return [True, False] if kind.get("type") == "boolean" else []


def _changed(options: BaseModel, name: str, value: Any) -> BaseModel | None:
    """Return the options with another value of one of them; None if it is not allowed."""
    try:
        return type(options).model_validate({**options.model_dump(), name: value})
    except pydantic.ValidationError:
        return None


def _outcome(options: BaseModel, decide: Decide) -> Any:
    """Return what options decide, or the error of incompatible options."""
    try:
        return decide(options)
    except InputError as error:
        return error


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) or value is None else str(value)
