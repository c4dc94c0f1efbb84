"""A problem as stored in a run folder: problem.toml with arrays in files, from which it can be recreated.

A problem with an XML scene becomes a problem file with absolute paths and its arrays in the folder `problem`. A gallery problem becomes
its name and options. Other problems, made in Python, are described without what TOML cannot express, such as functions.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from unrender.core import tables
from unrender.io import files, toml_lines
from unrender.rendering.expressions import expression_layer
from unrender.scene.bounds import ends_of
from unrender.scene.parameter import Unknown
from unrender.scene.problem import Problem
from unrender.scene.view_worlds import requested_depth

FILE, ARRAYS = "problem.toml", "problem"
_INLINE = 64  # maximum number of elements of an array that is written into the file itself


def save(problem: Problem, folder: Path) -> None:
    """Write problem.toml and its arrays. Raises `InputError` if they cannot be written."""
    if "gallery" in problem.origin:
        options = {key: _option(value) for key, value in problem.origin["options"].items()}
        document, note = {"gallery": problem.origin["gallery"], "options": options}, "The problem, of the gallery"
    elif "scene" in problem.origin:
        document, note = _described(problem, folder), "The problem as it was when the run began"
    else:
        document = _described(problem, folder)
        note = "A description of a problem made in Python; resume(..., problem=) needs the problem itself"
    if (folder / ARRAYS).is_dir():
        files.sync_folder(folder / ARRAYS)
    files.write(folder / FILE, toml_lines.encode(f"# {note}\n{tomli_w.dumps(document)}", str(folder / FILE)))


def origin(problem: Problem) -> dict[str, Any]:
    """Return `Problem.origin` in types of JSON."""
    options = problem.origin.get("options")
    return dict(problem.origin) | ({} if options is None else {"options": {k: _option(v) for k, v in options.items()}})


def _described(problem: Problem, folder: Path) -> dict[str, Any]:
    rebuilt = "scene" in problem.origin
    store = _Arrays(folder if rebuilt else None)
    parameters = [_parameter(index, unknown, store) for index, unknown in enumerate(problem.unknowns.values())]
    views = []
    for index, view in enumerate(problem.original_views):
        table: dict[str, Any] = {"sensor": int(view.sensor), "weight": float(view.weight)}
        for name, picture in (("reference", view.reference), ("mask", view.mask)):
            if picture is not None:
                table |= store.field(name, picture, f"view{index}-{name}", inline=False)
        if isinstance(view.scene, (str, Path)):
            table["scene"] = str(Path(view.scene).resolve())
        if view.aov is not None:
            table["aov"] = view.aov
        if view.known:
            known = [store.field(key, x, f"view{index}-{n}") for n, (key, x) in enumerate(view.known.items())]
            table["with"] = {key: value for part in known for key, value in part.items()}
        views.append(table)
    scene: dict[str, Any] = {"scene": problem.origin["scene"]} if rebuilt else {}
    depth = requested_depth(problem.renderer, problem.original_views, problem.max_depth)
    scene |= {} if depth is None else {"max_depth": depth}
    head = {"name": problem.name, **scene, "loss": _component(problem.loss)}
    layer = expression_layer(problem.renderer)
    texts = {} if layer is None else {one.key: one.text for one in layer.expressions if one.text is not None}
    return {**head, **({"expressions": texts} if texts else {}), "parameters": parameters, "views": views}


def _parameter(index: int, unknown: Unknown, store: _Arrays) -> dict[str, Any]:
    parameter = unknown.parameter
    table: dict[str, Any] = {"key": parameter.key}
    if parameter.keys is not None:
        table["keys"] = dict(parameter.keys) if isinstance(parameter.keys, Mapping) else list(parameter.keys)
    if parameter.initial is not None:
        table |= store.field("initial", parameter.initial, f"parameter{index}-initial")
    if parameter.bounds is not None:
        table["bounds"] = list(ends_of(parameter.bounds))
    if parameter.learning_rate is not None:
        table["learning_rate"] = float(parameter.learning_rate)
    if parameter.preconditioner is not None:
        table["preconditioner"] = _component(parameter.preconditioner)
    if unknown.parameterisation is not None:
        table["parameterisation"] = _component(unknown.parameterisation)
    for name in ("coarse_to_fine", "regularizer", "prior", "remeshing"):
        if (setting := getattr(unknown, name)) is not None:
            table[name] = tables.fields(setting)
    if parameter.self_intersection != "warn":
        table["self_intersection"] = parameter.self_intersection
    if unknown.truth is not None:
        table |= store.field("truth", unknown.truth, f"parameter{index}-truth")
    return table


@dataclasses.dataclass(frozen=True)
class _Arrays:
    """Folder of arrays that are too long for the file; None to omit them."""

    folder: Path | None

    def field(self, name: str, value: Any, file: str, inline: bool = True) -> dict[str, Any]:
        """Return {name: entry for `value`}; empty if the value is omitted."""
        if isinstance(value, (str, Path)):
            return {name: str(Path(value).resolve())}
        array = np.asarray(value)
        if inline and array.size <= _INLINE and array.ndim <= 1:
            return {name: array.tolist()}
        if self.folder is None:
            return {}
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        files.write(self.folder / ARRAYS / f"{file}.npy", buffer.getvalue(), name_too=False)
        return {name: f"{ARRAYS}/{file}.npy"}


def _option(value: Any) -> Any:
    return value if isinstance(value, (bool, int, float, str)) else _component(value)


def _component(value: Any) -> Any:
    """Return the table of a loss, preconditioner or parameterisation; for an unregistered one its `repr`, which no reader accepts."""
    if isinstance(value, Mapping):
        return dict(value)
    try:
        return tables.table(value)
    except tables.NotStorable:
        return repr(value)
