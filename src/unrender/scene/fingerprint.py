"""Hashes of the parts of a problem, to compare two problems and list their differences."""

from __future__ import annotations

import hashlib
import weakref
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays
from unrender.io import scene_files
from unrender.losses import FunctionLoss
from unrender.rendering.expressions import expression_layer
from unrender.rendering.renderer import Renderer
from unrender.rendering.worlds import WorldsRenderer
from unrender.rendering.wrapper import layers
from unrender.scene.parameter import ties_of
from unrender.scene.problem import Problem

_DIGEST = "sha256:"
_MOST_OBJECTS, _MOST_SHOWN = 64, 6
_known: weakref.WeakKeyDictionary[Problem, dict[str, str]] = weakref.WeakKeyDictionary()


def fingerprint(problem: Problem) -> dict[str, str]:
    """Return {part of the problem: its text, or the SHA-256 of its numbers}.

    Parts are the loss, the maximum path length, each unknown with its initial value, each view, the numbers of each scene object without
    the unknowns and, for XML scenes, every file that they consist of. The result is cached per problem.
    """
    if problem not in _known:
        _known[problem] = _take(problem)
    return dict(_known[problem])


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return one phrase per difference, such as "loss was L1(), is L2()" or "file room.xml has changed"."""
    changes = []
    for part in dict.fromkeys([*before, *now]):
        old, new = before.get(part), now.get(part)
        if old == new:
            continue
        if old is None or new is None:
            changes.append(f"{part} is {'gone' if new is None else 'new'}")
        elif old.startswith(_DIGEST) or new.startswith(_DIGEST):
            changes.append(f"{part} has changed")
        else:
            changes.append(f"{part} was {old}, is {new}")
    return changes


def shortened(changes: Sequence[str]) -> str:
    """Join the phrases of `differences` to one line with at most six of them."""
    more = f" and {len(changes) - _MOST_SHOWN} more" if len(changes) > _MOST_SHOWN else ""
    return "; ".join(changes[:_MOST_SHOWN]) + more


def digest(*parts: bytes) -> str:
    """Return the first 32 hexadecimal digits of the SHA-256 of bytes, in the format that `differences` recognises."""
    state = hashlib.sha256()
    for part in parts:
        state.update(part)
    return _DIGEST + state.hexdigest()[:32]


def _take(problem: Problem) -> dict[str, str]:
    parts = {"loss": repr(problem.loss), "max_depth": str(problem.max_depth)}
    start = problem.initial()
    for key, unknown in problem.unknowns.items():
        parts[f"parameter {key}: initial"] = _of_array(arrays.numpy(start[key]))
        parts[f"parameter {key}: bounds"] = str(unknown.bounds)
        parts[f"parameter {key}: learning_rate"] = str(unknown.learning_rate)
        parts[f"parameter {key}: preconditioner"] = repr(unknown.preconditioner)
        for name in ("parameterisation", "regularizer", "prior", "remeshing", "coarse_to_fine"):
            if (setting := getattr(unknown, name)) is not None:
                parts[f"parameter {key}: {name}"] = repr(setting)
        if unknown.parameter.keys is not None:
            parts[f"parameter {key}: keys"] = repr(ties_of([unknown.parameter])[0].factors)
        if unknown.parameter.self_intersection == "prevent":
            parts[f"parameter {key}: self_intersection"] = "prevent"
    for index, view in enumerate(problem.views):
        parts[f"view {index}: sensor"] = str(view.sensor)
        parts[f"view {index}: weight"] = str(view.weight)
        parts[f"view {index}: reference"] = _of_array(np.asarray(view.reference))
        parts[f"view {index}: mask"] = "none" if view.mask is None else _of_array(np.asarray(view.mask))
    if isinstance(
        problem.loss, FunctionLoss
    ):  # functions of one name may differ; threads change the last digits of sums
        reference = np.asarray(problem.views[0].reference, np.float32)
        value = problem.loss_value(0, problem.renderer.array(0.9 * reference + 0.05))
        parts["loss near the first reference"] = f"{arrays.number(value):.5g}"
    if (layer := expression_layer(problem.renderer)) is not None:
        parts |= {f"expression of {one.key}": one.text or "a function" for one in layer.expressions}
        functions = [one.key for one in layer.expressions if one.text is None]
        results = [
            layer.scene_values({key: x * a for key, x in layer.unknowns.items()}) for a in (1.01, 1.0) if functions
        ]
        for key in functions:
            parts[f"value of the expression of {key} near the start"] = digest(*(of[key].tobytes() for of in results))
    worlds = next((layer for layer in layers(problem.renderer) if isinstance(layer, WorldsRenderer)), None)
    for index, view in enumerate(problem.original_views):
        if not view.own_world:
            continue
        world = None if worlds is None else worlds.state_of(problem.views[index].sensor)  # None if it only turns lights
        values = view.known or {} if world is None else world.values
        fields = {f"known {key}": _of_array(np.asarray(x, np.float32)) for key, x in sorted(values.items())}
        if isinstance(view.scene, (str, Path)):
            fields["scene"] = str(Path(view.scene).resolve())
        elif view.scene is not None and world is not None:
            fields["scene"] = digest(*(part for parts in _objects(world.renderer).values() for part in parts))
        fields |= {} if view.aov is None else {"aov": view.aov}
        parts |= {f"view {index}: {name}": value for name, value in fields.items()}
    return parts | _of_scene(problem) | _of_files(problem)


def _of_array(array: np.ndarray) -> str:
    return digest(f"{array.dtype} {array.shape}".encode(), np.ascontiguousarray(array).tobytes())


def _of_scene(problem: Problem) -> dict[str, str]:
    objects = _objects(problem.renderer, problem.unknowns)
    if len(objects) > _MOST_OBJECTS:
        return {"scene": digest(*(part for parts in objects.values() for part in parts))}
    return {f"scene: {name}": digest(*parts) for name, parts in objects.items()}


def _objects(renderer: Renderer, without: Container[str] = ()) -> dict[str, list[bytes]]:
    """Return {object of a scene: its keys with the hashes of their values}."""
    known = renderer.parameters()
    keys = sorted(key for key, info in known.items() if (info.perturbable or info.compiled) and key not in without)
    objects: dict[str, list[bytes]] = {}
    for key, value in renderer.values(keys).items():
        name = key.partition(".")[0]
        objects.setdefault(name, []).append(f"{key} {_of_array(arrays.numpy(value))}".encode())
    return objects


def _of_files(problem: Problem) -> dict[str, str]:
    """Return the hash of each file of the XML scenes: the problem's and those of single views."""
    named = (problem.origin.get("scene"), *(view.scene for view in problem.original_views))
    scenes = list(dict.fromkeys(Path(scene).resolve() for scene in named if isinstance(scene, (str, Path))))
    paths = dict.fromkeys(path for scene in scenes for path in scene_files.of(scene))
    return {f"file {_shown(path, scenes[0].parent)}": _of_file(path) for path in paths}


def _shown(path: Path, root: Path) -> str:
    return str(path.relative_to(root)) if path.is_relative_to(root) else str(path)


def _of_file(path: Path) -> str:
    state: Any = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            state.update(block)
    return _DIGEST + state.hexdigest()[:32]
