"""A problem as a run folder keeps it: problem.toml, and arrays beside it, so that it can be made again.

A problem whose scene is XML becomes a problem file, its paths absolute and its arrays in the folder `problem`. One of the gallery
becomes its name and options. Of others, made in Python, the file says what it can.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from unrender.io import files
from unrender.problem.components import LOSSES, PRECONDITIONERS
from unrender.problem.parameter import Parameter
from unrender.problem.problem import Problem

FILE, ARRAYS = "problem.toml", "problem"
_INLINE = 64
"""Numbers of an array that may stand in the file itself."""


def save(problem: Problem, folder: Path) -> None:
    """Write problem.toml and what it needs beside it. Raises `InputError` where they cannot be written."""
    if "gallery" in problem.origin:
        options = {key: _option(value) for key, value in problem.origin["options"].items()}
        said, note = {"gallery": problem.origin["gallery"], "options": options}, "The problem, of the gallery"
    elif "scene" in problem.origin:
        said, note = _described(problem, folder), "The problem as it was when the run began"
    else:
        said, note = (
            _described(problem, folder),
            "What can be said of a problem made in Python; resume(..., problem=) needs it handed in",
        )
    files.write(folder / FILE, f"# {note}\n{tomli_w.dumps(said)}".encode())


def origin(problem: Problem) -> dict[str, Any]:
    """`Problem.origin` in words that JSON has."""
    options = problem.origin.get("options")
    return problem.origin | ({} if options is None else {"options": {k: _option(v) for k, v in options.items()}})


def _described(problem: Problem, folder: Path) -> dict[str, Any]:
    rebuilt = "scene" in problem.origin
    keep = _Arrays(folder if rebuilt else None)
    parameters = [_parameter(problem, index, one, keep) for index, one in enumerate(problem.parameters)]
    views = []
    for index, view in enumerate(problem.given_views):
        said: dict[str, Any] = {"sensor": int(view.sensor), "weight": float(view.weight)}
        for name, picture in (("reference", view.reference), ("mask", view.mask)):
            if picture is not None:
                said |= keep.field(name, picture, f"view{index}-{name}", inline=False)
        views.append(said)
    scene = {"scene": problem.origin["scene"]} if rebuilt else {}
    head = {"name": problem.name, **scene, "max_depth": problem.max_depth, "loss": _component(problem.loss, LOSSES)}
    return {**head, "parameters": parameters, "views": views}


def _parameter(problem: Problem, index: int, parameter: Parameter, keep: _Arrays) -> dict[str, Any]:
    said: dict[str, Any] = {"key": parameter.key}
    if parameter.initial is not None:
        said |= keep.field("initial", parameter.initial, f"parameter{index}-initial")
    if parameter.bounds is not None:
        low, high = parameter.bounds
        said["bounds"] = [-np.inf if low is None else float(low), np.inf if high is None else float(high)]
    if parameter.learning_rate is not None:
        said["learning_rate"] = float(parameter.learning_rate)
    if parameter.preconditioner is not None:
        said["preconditioner"] = _component(parameter.preconditioner, PRECONDITIONERS)
    if parameter.key in problem.coarse_to_fine:
        said["coarse_to_fine"] = _fields(problem.coarse_to_fine[parameter.key])
    if parameter.key in problem.truth:
        said |= keep.field("truth", problem.truth[parameter.key], f"parameter{index}-truth")
    return said


@dataclasses.dataclass(frozen=True)
class _Arrays:
    """Where arrays go that are too long for the file; None for nowhere."""

    folder: Path | None

    def field(self, name: str, value: Any, file: str, inline: bool = True) -> dict[str, Any]:
        """{name: what the problem file says for `value`}; empty where it cannot be said."""
        if isinstance(value, (str, Path)):
            return {name: str(Path(value).resolve())}
        array = np.asarray(value)
        if inline and array.size <= _INLINE and array.ndim <= 1:
            return {name: array.tolist()}
        if self.folder is None:
            return {}
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        files.write(self.folder / ARRAYS / f"{file}.npy", buffer.getvalue())
        return {name: f"{ARRAYS}/{file}.npy"}


def _option(value: Any) -> Any:
    return value if isinstance(value, (bool, int, float, str)) else _component(value, LOSSES)


def _component(value: Any, kinds: Mapping[str, type]) -> Any:
    """The table of a loss or a preconditioner; of one that has none, words that no reader takes for one."""
    if isinstance(value, Mapping):
        return dict(value)
    if kinds.get(type(value).__name__) is not type(value):
        return repr(value)
    return {"type": type(value).__name__, **_fields(value)}


def _fields(value: Any) -> dict[str, Any]:
    fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in fields.items()}
