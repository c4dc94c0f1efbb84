"""Options of gallery problems: typed fields of their specifications, with checks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from unrender.core import checks, registry, tables
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, in_words
from unrender.losses import L2, Loss

_LONGEST_SIDE = 1 << 13  # pixels along a side of an image with the largest number of values that is read from a file


@dataclass(frozen=True)
class Option:
    """An option of a gallery problem.

    Attributes:
        name: keyword.
        kind: `int`, `str`, or `Loss`, which can be passed by name.
        about: description in one line.
    """

    name: str
    kind: type
    default: Any
    about: str


def integer(default: int, about: str, at_least: int = 1, at_most: int = 2**31 - 1) -> Any:
    """Return a dataclass field of an `Option`: an integer in [at_least, at_most], described by `about`."""

    def check(owner: str, name: str, value: Any) -> int:
        return checks.integer(owner, name, value, at_least, at_most)

    return field(default=default, metadata={"kind": int, "about": about, "check": check})


def resolution(default: int) -> Any:
    """Return the field `resolution`: pixels along a side of each view, in [4, 8192]."""
    return integer(default, "pixels along a side of each view", at_least=4, at_most=_LONGEST_SIDE)


def texture_resolution(default: int) -> Any:
    """Return the field `texture_resolution`: texels along a side of each unknown map, in [2, 8192]."""
    return integer(default, "texels along a side of each unknown map", at_least=2, at_most=_LONGEST_SIDE)


def reference_spp(default: int) -> Any:
    """Return the field `reference_spp`: samples per pixel of the references, in [1, 2²⁴]."""
    return integer(default, "samples per pixel of the reference images", at_most=1 << 24)


def max_depth(default: int, at_least: int) -> Any:
    """Return the field `max_depth`: maximum path length in segments, in [at_least, 2²⁰]."""
    return integer(default, "maximum path length in segments", at_least=at_least, at_most=1 << 20)


def choice(default: str, about: str, among: tuple[str, ...]) -> Any:
    """Return a dataclass field of an `Option`: one of the words `among`."""

    def check(owner: str, name: str, value: Any) -> str:
        if not isinstance(value, str) or value not in among:
            raise InputError(f"{owner}: {name} must be one of {', '.join(among)}, got {in_words(value)}")
        return value

    return field(default=default, metadata={"kind": str, "about": about, "check": check})


def _check_loss(owner: str, name: str, value: Any) -> Loss:
    known = registry.component_of(type(value))
    if known is not None and known.kind == "loss":
        return value
    if not isinstance(value, (str, Mapping)):
        raise InputError(f"{owner}: {name} must be one of unrender.losses or its name, got {in_words(value)}")
    return tables.component(value, "loss", f"{owner}: {name}")


LOSS = {"kind": Loss, "about": "L1, L2, RelativeL2, Huber, Perceptual or another registered loss", "check": _check_loss}
"""Metadata of the field `loss`."""


@dataclass(frozen=True)
class Rendered:
    """Options that all rendered problems have, with the most frequent defaults; other defaults override these."""

    resolution: int = resolution(48)
    reference_spp: int = reference_spp(1024)
    max_depth: int = max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=LOSS)


def of(specification: type) -> list[Option]:
    """Return the options of a specification, in order."""
    return [Option(f.name, f.metadata["kind"], f.default, f.metadata["about"]) for f in _fields(specification).values()]


def fill(name: str, specification: type, options: Mapping[str, Any]) -> Any:
    """Return the specification with these options and other defaults. Raises `InputError` for one that is unknown or out of range."""
    fields = _fields(specification)
    owner = f"gallery problem {name}"
    taken = {}
    for key, value in options.items():
        if key not in fields:
            hint = did_you_mean(key, fields) or f"; it has {', '.join(fields)}"
            raise InputError(f"{owner}: no option {key}{hint}")
        taken[key] = fields[key].metadata["check"](owner, key, value)
    return specification(**taken)


def _fields(specification: type) -> dict[str, dataclasses.Field[Any]]:
    last = ("reference_spp", "max_depth", "loss")  # after those of the problem itself
    ordered = sorted(dataclasses.fields(specification), key=lambda f: f.name in last)
    return {f.name: f for f in ordered}
