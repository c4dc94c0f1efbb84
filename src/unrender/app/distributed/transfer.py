"""Transfer of a problem to workers: each builds it with its own views only, and reads their references itself."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.expressions import expression_layer
from unrender.rendering.photographs import scene_renderer, sensors_with_rows, with_photographs
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem, open_scene
from unrender.scene.references import View
from unrender.scene.view_worlds import requested_depth

_Owner = TypeVar("_Owner", View, Parameter)


class _Parts(NamedTuple):
    """Arguments of `Problem`, and the sensors that have exposures or poses; None if these are not parameters."""

    scene: Any
    parameters: Any
    views: Any
    loss: Any
    max_depth: int | None
    name: str
    sensors: tuple[int, ...] | None
    expressions: Any


def packed(problem: Problem, views: Sequence[int], ray: Any) -> bytes:
    """Return the serialised problem of these views for `unpacked`. References that were given as files are sent as paths.

    Raises `InputError` for a loaded scene, or a function or object of this process.
    """
    located_views = [_located(problem.original_views[view], "reference", "mask", "scene") for view in views]
    parameters = tuple(_located(parameter, "initial") for parameter in problem.parameters)
    sensors = sensors_with_rows(problem.renderer)
    moved = any(view.sensor != own.sensor for view, own in zip(problem.views, problem.original_views, strict=True))
    if sensors is not None and moved:
        raise InputError(
            f"workers: {problem.name} has camera parameters of photographs and views of different scenes, which workers do not "
            "support together; leave --workers out"
        )
    layer = expression_layer(problem.renderer)
    parts = _Parts(
        _scene(problem),
        parameters,
        located_views,
        problem.loss,
        requested_depth(problem.renderer, problem.original_views, problem.max_depth),
        problem.name,
        sensors,
        {} if layer is None else {one.key: one.text or one.function for one in layer.expressions},
    )
    buffer = io.BytesIO()
    try:
        _pickler(ray)(buffer).dump(parts)
    except (TypeError, ValueError, AttributeError, RecursionError, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"workers: {problem.name} cannot be sent to them ({reason}); use a problem file with a scene in XML, or a "
            "scene as a dictionary of plain values"
        ) from error
    except Exception as error:  # pickle.PicklingError, of cloudpickle's own kinds
        raise InputError(f"workers: {problem.name} cannot be sent to them: {str(error)[:200]}") from error
    return buffer.getvalue()


def unpacked(blob: bytes, ray: Any) -> Problem:
    """Return the problem. The variant must be active. Raise `InputError` if a file is missing on this machine."""
    parts: _Parts = ray.cloudpickle.loads(blob)
    scene = parts.scene
    if parts.sensors is not None:
        keys = [parameter.key for parameter in parts.parameters]
        scene = open_scene(scene, parts.max_depth, parts.parameters, (), parts.expressions)
        scene = with_photographs(scene, keys, parts.sensors)
    return Problem(
        scene,
        parts.parameters,
        parts.views,
        parts.loss,
        parts.max_depth,
        name=parts.name,
        expressions=parts.expressions,
        partial=True,
    )


def _scene(problem: Problem) -> Any:
    if "scene" in problem.origin:
        return problem.origin["scene"]
    renderer = scene_renderer(problem.renderer)
    pair = getattr(renderer, "pair", None)
    description = getattr(pair, "description", None)
    if description is None:
        return renderer  # not a Mitsuba scene
    if getattr(pair, "single", False):
        raise InputError(
            "workers: a loaded scene cannot be sent to them; give its XML file, its dictionary, or a function that returns one"
        )
    return str(Path(description).resolve()) if isinstance(description, (str, Path)) else description


def _located(owner: _Owner, *names: str) -> _Owner:
    """Return the object with absolute file names, since workers have other working directories."""
    paths = {name: value for name in names if isinstance(value := getattr(owner, name), (str, Path))}
    located: dict[str, Any] = {name: Path(value).absolute() for name, value in paths.items()}
    if isinstance(owner, View) and owner.known is not None:
        known = owner.known.items()
        located["known"] = {k: Path(x).absolute() if isinstance(x, (str, Path)) else x for k, x in known}
    return replace(owner, **located)


def _pickler(ray: Any) -> Any:
    """Return a pickler that serialises functions by value, and Mitsuba objects of dictionaries by their contents."""

    class Pickler(ray.cloudpickle.CloudPickler):
        def reducer_override(self, obj: Any) -> Any:
            kind = type(obj)
            if kind.__module__.partition(".")[0] == "mitsuba":
                if kind.__name__.startswith("ScalarAffineTransform") or kind.__name__.startswith("ScalarProjective"):
                    return _transform, (kind.__name__, np.array(obj.matrix, np.float64))
                if kind.__name__ == "Bitmap":
                    return _bitmap, (np.array(obj), bool(obj.srgb_gamma()))
            return super().reducer_override(obj)

    return Pickler


def _transform(kind: str, matrix: np.ndarray) -> Any:
    import mitsuba as mi

    return getattr(mi, kind)(matrix)


def _bitmap(values: np.ndarray, gamma: bool) -> Any:
    import mitsuba as mi

    made = mi.Bitmap(values)
    made.set_srgb_gamma(gamma)
    return made
