"""Components as tables of a TOML file, and back: what a run was made of, so that it can be made again.

    estimator = { type = "PathGradient", spp = 2, image = { type = "RecursiveControlVariate", space = "path" } }

TOML has no null: fields that are None are left out where that is their default, and else named under "none".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from unrender import images, losses, optimizers, pixels, preconditioners, schedules
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.estimators.loss_values import LossValues
from unrender.estimators.meta import MetaEstimator
from unrender.estimators.path import PathGradient
from unrender.estimators.smoothed import SmoothedDerivatives

_TYPE, _NONE = "type", "none"
_DEEPEST = 16
_LONGEST_LIST = 4096


class NotStorable(Exception):
    """A component that no table can say, such as one with a function for its schedule."""


def _exported(*modules: Any) -> dict[str, type]:
    found: dict[str, type] = {}
    for module in modules:
        for name, kind in vars(module).items():
            if isinstance(kind, type) and dataclasses.is_dataclass(kind) and not name.startswith("_"):
                assert found.setdefault(name, kind) is kind, f"two components are called {name}"
    return found


KINDS: dict[str, type] = {
    **_exported(images, pixels, optimizers, schedules, losses, preconditioners),
    **{kind.__name__: kind for kind in (PathGradient, MetaEstimator, SmoothedDerivatives, LossValues)},
}
"""Every component that may stand in a table, by name."""


def table(component: Any) -> dict[str, Any]:
    """The table of a component. Raises `NotStorable`, with what cannot be said."""
    kind = type(component)
    if KINDS.get(kind.__name__) is not kind:
        raise NotStorable(f"{kind.__name__} is no component of this package")
    found: dict[str, Any] = {_TYPE: kind.__name__}
    none = []
    for field in dataclasses.fields(component):
        value = getattr(component, field.name)
        if value is not None:
            found[field.name] = _said(value, f"{kind.__name__}.{field.name}")
        elif field.default is not None:
            none.append(field.name)
    return found | ({_NONE: none} if none else {})


def component(given: Any, where: str, depth: int = 0) -> Any:
    """The component that a table says.

    Raises:
        InputError: unknown types or fields, values of the wrong type or out of range.
    """
    if not isinstance(given, Mapping) or not isinstance(given.get(_TYPE), str):
        raise InputError(f'{where}: expected a table such as {{ type = "Adam" }}, got {repr(given)[:80]}')
    if depth > _DEEPEST:
        raise InputError(f"{where}: nested too deeply")
    name = given[_TYPE]
    if name not in KINDS:
        raise InputError(f'{where}: unknown type "{name[:60]}"{did_you_mean(name, KINDS)}')
    fields = {field.name for field in dataclasses.fields(KINDS[name])}
    none = given.get(_NONE, [])
    if not isinstance(none, list) or any(key not in fields for key in none if isinstance(key, str)):
        raise InputError(f"{where}: none: expected a list of fields of {name}, got {repr(none)[:80]}")
    arguments: dict[str, Any] = dict.fromkeys(none)
    for key, value in given.items():
        if key in (_TYPE, _NONE):
            continue
        if key not in fields:
            raise InputError(f"{where}: {name} has no option {key[:60]}{did_you_mean(key, fields)}")
        arguments[key] = component(value, f"{where}.{key}", depth + 1) if _is_table(value) else value
    try:
        return KINDS[name](**arguments)
    except (TypeError, ValueError, AttributeError) as error:  # InputError among them
        raise InputError(f"{where}: {' '.join(str(error).split())[:200]}") from error


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping) and _TYPE in value


def _said(value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return table(value)
    if isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.generic) and value.dtype.kind in "fiub":
        return value.item()
    if isinstance(value, Mapping) and all(isinstance(key, str) and key != _TYPE for key in value):
        return {key: _said(part, where) for key, part in value.items()}
    if isinstance(value, (list, tuple)) and len(value) <= _LONGEST_LIST:
        return [_said(part, where) for part in value]
    raise NotStorable(f"{where} is {type(value).__name__}, which no file can say")
