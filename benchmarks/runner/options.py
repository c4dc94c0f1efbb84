"""Command-line options from the parameters of a benchmark's `run`."""

from __future__ import annotations

import argparse
import inspect
import re
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

COMMON = {
    "assets": "folder of the scenes of others",
    "count": "pixels a step",
    "grid": "voxels along a side",
    "only": "methods to run; the others' figures stay",
    "part": "what to measure; the others' figures stay",
    "problem": "problems to run",
    "rates": "learning rates to try",
    "reference_spp": "samples per pixel of the references",
    "resolution": "pixels along a side of a picture",
    "runs": "independent runs of each",
    "seconds": "budget of a run",
    "seeds": "runs of each method",
    "spp": "samples per pixel",
    "steps": "number of steps of a run",
    "texture": "texels along a side",
    "views": "number of pictures",
}
"""Help of options that several benchmarks have; the "Args:" of a benchmark come first."""


def add_options(parser: argparse.ArgumentParser, function: Callable[..., Any]) -> list[str]:
    """An option for each parameter, helped by the "Args:" of its docstring, or `COMMON`; the parameters' names.

    Types: int, float, str, bool, Path, any of these or None, and tuples of one of them. A tuple's default that is not empty lists its
    choices. A parameter without a default is an argument by position.
    """
    hints, helps = typing.get_type_hints(function), _arguments(inspect.getdoc(function) or "")
    names = list(inspect.signature(function).parameters)
    for name, parameter in inspect.signature(function).parameters.items():
        kind, many = _kind(hints[name])
        default, text = parameter.default, helps.get(name, COMMON.get(name, "")).replace("%", "%%")
        if default is inspect.Parameter.empty:
            parser.add_argument(name, type=kind, help=text)
            continue
        usual = " ".join(map(str, default)) if many else default
        text = f"{text} ({'all' if many and kind is str and default else usual})".strip() if usual is not None else text
        option = f"--{name.replace('_', '-')}"
        common: dict[str, Any] = {"default": argparse.SUPPRESS, "help": text, "dest": name}
        if kind is bool:
            parser.add_argument(option, action=argparse.BooleanOptionalAction, **common)
        elif many:
            choices = default if kind is str and default else None
            parser.add_argument(option, nargs="+", type=kind, choices=choices, **common)
        else:
            parser.add_argument(option, type=kind, **common)
    return names


def _kind(hint: Any) -> tuple[type, bool]:
    """The type of one value, and whether several are taken."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(part for part in typing.get_args(hint) if part is not type(None))
    many = typing.get_origin(hint) is tuple
    kind = typing.get_args(hint)[0] if many else hint
    if kind not in (int, float, str, bool, Path):
        raise TypeError(f"no option can be made of the type {hint}")
    return kind, many


def _arguments(docstring: str) -> dict[str, str]:
    """What "Args:" says of each parameter."""
    _, _, block = docstring.partition("Args:\n")
    block = block.partition("\n\n")[0]
    found = re.findall(r"^ {4}(\w+): (.*?)(?=^ {4}\w+: |\Z)", block + "\n", flags=re.MULTILINE | re.DOTALL)
    return {name: " ".join(text.split()) for name, text in found}


def defaults(function: Callable[..., Any]) -> dict[str, Any]:
    """The parameters that have a default."""
    parameters = inspect.signature(function).parameters.items()
    return {name: p.default for name, p in parameters if p.default is not inspect.Parameter.empty}
