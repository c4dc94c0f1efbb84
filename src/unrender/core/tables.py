"""Components as tables of a TOML file, and back.

    estimator = { type = "PathGradient", spp = 2, image = { type = "RecursiveControlVariate", space = "path" } }

A component is a registered frozen dataclass (`core.registry`); its table has a type and fields. A field whose annotation is a protocol
takes components of that kind only, and a text in place of a table: `loss = "L1"`, `schedule = "cosine(300)"`. TOML has no null: fields
that are None are omitted if this is their default, and listed under "none" otherwise.
"""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from unrender.core import registry
from unrender.core.errors import InputError, prefixed
from unrender.core.registry import GROUP
from unrender.core.text import did_you_mean, in_words

_CALL = re.compile(r"\s*([A-Za-z_]\w*)\s*(?:\(([^()]*)\))?\s*")
_NEXT = "then"  # name of the field for the component after the word "then"


def parse(text: str, kind: str) -> Any:
    """Return the component of a text: its name, in any case, and the values of its first fields in order.

    Args:
        text: "name", "name(number, ...)", or two of these with "then" between them if the first has a field `then`.
        kind: kind of component, one of `registry.KINDS`.

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
    texts = [part.strip() for part in match[2].split(",")] if match[2] and match[2].strip() else []
    required = [field.name for field in numbers if field.default is dataclasses.MISSING]
    if not len(required) <= len(texts) <= len(numbers):
        raise InputError(f"{kind}: expected {name}({', '.join(field.name for field in numbers)}), got {text!r}")
    arguments: dict[str, Any] = {field.name: _number(part, kind) for field, part in zip(numbers, texts, strict=False)}
    if rest:
        if len(numbers) == len(every):
            names = (name for name, of in known.items() if any(each.name == _NEXT for each in dataclasses.fields(of)))
            raise InputError(f'{kind}: only {", ".join(names)} can have something after "then", got {text!r}')
        arguments[_NEXT] = parse(rest[0], kind)
    with prefixed(kind):
        return known[name](**arguments)


def _number(text: str, kind: str) -> int | float:
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            pass
    raise InputError(f"{kind}: expected a number, got {text!r}")


_TYPE, _NONE = "type", "none"
_IN_SHORT = ("parameterisation", "schedule")  # kinds that have a short text form, "name(number, ...)" (`core.tables`)
_DEEPEST = 16
_LONGEST_LIST = 4096
_T = TypeVar("_T")


class NotStorable(Exception):
    """A component that no table can describe, such as one whose schedule is a function."""


def table(component: Any) -> dict[str, Any]:
    """Return the table of a component. Raises `NotStorable` with the reason."""
    kind = type(component)
    known = registry.component_of(kind)
    if known is None:
        raise NotStorable(f"{kind.__name__} is not registered, see unrender.register")
    return {_TYPE: known.name, **fields(component)}


def fields(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass in types of TOML. Raises `NotStorable` with the reason."""
    values: dict[str, Any] = {}
    none = []
    for field in dataclasses.fields(value):
        if not field.init:
            continue
        part = getattr(value, field.name)
        if part is not None:
            values[field.name] = _plain(part, f"{type(value).__name__}.{field.name}")
        elif field.default is not None:
            none.append(field.name)
    return values | ({_NONE: none} if none else {})


def component(table: Any, kind: str | None = None, where: str = "", folder: Path | None = None) -> Any:
    """Return the component of a table, or of the short text form of its kind.

    Args:
        table: {"type": name, field: value, ...}; if `kind` is set also "name", or the short form of a kind that has one.
        kind: kind of component, one of `registry.KINDS`; None accepts every kind that tables can store.
        where: prefix of messages.
        folder: folder to which relative paths refer; None leaves them unchanged.

    Raises:
        InputError: unknown types or fields (with the nearest known one), missing fields, values of the wrong type or out of range.
    """
    with prefixed(where):
        return _component(table, kind, folder, 0)


def build(made_by: type[_T], fields: Mapping[str, Any]) -> _T:
    """Return a dataclass from a table of its fields. Raises `InputError` as `component` does."""
    return _build(made_by, made_by.__name__, fields, None, 0)


def options(made_by: type[_T], table: Any, example: str) -> _T:
    """Return a dataclass from an instance, or from a table of its fields such as `example`. Raises `InputError`."""
    if isinstance(table, made_by):
        return table
    if not isinstance(table, Mapping):
        raise InputError(f"expected a table such as {example}, got {in_words(table)}")
    return build(made_by, table)


def _component(table: Any, kind: str | None, folder: Path | None, depth: int) -> Any:
    if depth > _DEEPEST:
        raise InputError("nested too deeply")
    if kind in _IN_SHORT and isinstance(table, str):
        return parse(table, kind)
    table = {_TYPE: table} if kind is not None and isinstance(table, str) else table
    known = registry.table_components() if kind is None else registry.components(kind)
    if not isinstance(table, Mapping) or not isinstance(table.get(_TYPE), str):
        example = f'{{ type = "{"Adam" if kind is None else next(iter(known), "Name")}" }}'
        expected = f"a table such as {example}"
        expected = expected if kind is None else f"{_one_of(known)}, or {expected}"
        raise InputError(f"expected {expected}, got {in_words(table)}")
    name = table[_TYPE]
    if name not in known:
        raise InputError(_unknown(name, kind, known))
    return _build(known[name], name, {key: value for key, value in table.items() if key != _TYPE}, folder, depth)


def _build(made_by: type[_T], name: str, fields: Mapping[str, Any], folder: Path | None, depth: int) -> _T:
    known = {field.name: field for field in dataclasses.fields(made_by) if field.init}  # pyright: ignore[reportArgumentType]
    none = fields.get(_NONE, [])
    if _NONE not in known and (
        not isinstance(none, list) or any(not isinstance(key, str) or key not in known for key in none)
    ):
        raise InputError(f"none: expected a list of fields of {name}, got {in_words(none)}")
    arguments: dict[str, Any] = {} if _NONE in known else dict.fromkeys(none)
    hints = _hints(made_by)
    for key, value in fields.items():
        if key == _NONE and _NONE not in known:
            continue
        if key not in known:
            has = f"it has {', '.join(known)}" if known else "it has none"
            raise InputError(f"{name} has no option {str(key)[:60]}{did_you_mean(str(key), known) or f'; {has}'}")
        arguments[key] = _value(value, hints.get(key), key, folder, depth)
    for key, field in known.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and key not in arguments:
            raise InputError(f"{name} needs {key}")
    try:
        return made_by(**arguments)
    except InputError:
        raise
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{name}: a value of the wrong type: {' '.join(str(error).split())[:200]}") from error


def _value(value: Any, hint: Any, key: str, folder: Path | None, depth: int) -> Any:
    """Return a field's value: a component if its annotation is a component protocol, or if the value is a table with a type."""
    if value is None or registry.component_of(type(value)) is not None:
        return value
    choices = (hint, *typing.get_args(hint))
    kind = next((kind for kind in map(registry.kind_of_protocol, choices) if kind), None)
    if kind is not None and typing.get_origin(hint) is tuple and isinstance(value, (list, tuple)):
        return tuple(_value(part, choices[1], f"{key}[{index}]", folder, depth) for index, part in enumerate(value))
    if kind is not None or (isinstance(value, Mapping) and _TYPE in value):
        with prefixed(key):
            return _component(value, kind, folder, depth + 1)
    if folder is not None and isinstance(value, str) and Path in choices:
        return str(folder / value)
    return value


def _hints(made_by: type) -> dict[str, Any]:
    """Return the annotations of a dataclass; {} if they use names that are imported for type checking only."""
    try:
        return typing.get_type_hints(made_by)
    except Exception:  # whatever the evaluation of an annotation raises
        return {}


def _one_of(known: Mapping[str, type]) -> str:
    return " or ".join(f'"{name}"' for name in known) or "a registered component (there is none)"


def _unknown(name: str, kind: str | None, known: Mapping[str, type]) -> str:
    hint = did_you_mean(name, known)
    how = f'; install the package that registers it (entry-point group "{GROUP}"), or import its module first'
    if kind is not None:
        return f'expected {_one_of(known)}, got "{name[:60]}"{hint or how}'
    return f'unknown type "{name[:60]}"{hint}{how}'


def _plain(value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return table(value)
    if isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic) and value.dtype.kind in "fiub":
        return value.item()
    if isinstance(value, Mapping) and all(isinstance(key, str) and key != _TYPE for key in value):
        return {key: _plain(part, where) for key, part in value.items()}
    if isinstance(value, (list, tuple)) and len(value) <= _LONGEST_LIST:
        return [_plain(part, where) for part in value]
    raise NotStorable(f"{where} is {type(value).__name__}, which no file can describe")
