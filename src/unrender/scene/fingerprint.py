"""Hashes of the parts of a problem, to compare two problems and list their differences."""

from __future__ import annotations

import hashlib
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays
from unrender.io import scene_files
from unrender.rendering.expressions import expression_layer
from unrender.scene.parameter import ties_of
from unrender.scene.problem import Problem

_DIGEST = "sha256:"
_MOST_OBJECTS, _MOST_SHOWN = 64, 6
_known: weakref.WeakKeyDictionary[Problem, dict[str, str]] = weakref.WeakKeyDictionary()


def fingerprint(problem: Problem) -> dict[str, str]:
    """Return {part of the problem: its text, or the SHA-256 of its numbers}.

    Parts are the loss, the maximum path length, each unknown with its initial value, each view, the numbers of each scene object without
    the unknowns and, for an XML scene, every file that it consists of. The result is cached per problem.
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
    if (layer := expression_layer(problem.renderer)) is not None:
        parts |= {f"expression of {one.key}": one.text or "a function" for one in layer.expressions}
    for index, view in enumerate(problem.original_views):
        known = {} if view.known is None else dict(sorted(view.known.items()))
        fields = {
            f"known {key}": str(x) if isinstance(x, (str, Path)) else _of_array(np.asarray(x, np.float32))
            for key, x in known.items()
        }
        fields |= (
            {} if view.scene is None else {"scene": str(view.scene) if isinstance(view.scene, (str, Path)) else "given"}
        )
        fields |= {} if view.aov is None else {"aov": view.aov}
        parts |= {f"view {index}: {name}": value for name, value in fields.items()}
    return parts | _of_scene(problem) | _of_files(problem)


def _of_array(array: np.ndarray) -> str:
    return digest(f"{array.dtype} {array.shape}".encode(), np.ascontiguousarray(array).tobytes())


def _of_scene(problem: Problem) -> dict[str, str]:
    known, unknowns = problem.renderer.parameters(), problem.unknowns
    keys = sorted(key for key, info in known.items() if (info.perturbable or info.compiled) and key not in unknowns)
    objects: dict[str, list[bytes]] = {}
    for key, value in problem.renderer.values(keys).items():
        name = key.partition(".")[0]
        objects.setdefault(name, []).append(f"{key} {_of_array(arrays.numpy(value))}".encode())
    if len(objects) > _MOST_OBJECTS:
        return {"scene": digest(*(part for parts in objects.values() for part in parts))}
    return {f"scene: {name}": digest(*parts) for name, parts in objects.items()}


def _of_files(problem: Problem) -> dict[str, str]:
    scene = problem.origin.get("scene")
    if scene is None:
        return {}
    root = Path(scene).parent
    return {f"file {_shown(path, root)}": _of_file(path) for path in scene_files.of(Path(scene))}


def _shown(path: Path, root: Path) -> str:
    return str(path.relative_to(root)) if path.is_relative_to(root) else str(path)


def _of_file(path: Path) -> str:
    state: Any = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            state.update(block)
    return _DIGEST + state.hexdigest()[:32]
