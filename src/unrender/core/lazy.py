"""Lazy imports: names of a package, and modules, that are imported on first use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def attach(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package with lazy imports from {public name: module below the package}."""

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{homes[name]}"), name)

    return get


class Module:
    """A module below `unrender` that is imported when one of its attributes is first used."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(f"unrender.{self._name}"), name)


def modules(*names: str) -> tuple[Any, ...]:
    """Return a `Module` for each name."""
    return tuple(map(Module, names))
