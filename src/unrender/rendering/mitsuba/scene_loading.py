"""Loading a scene description, with errors in one line."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.backend import variant
from unrender.core.errors import InputError
from unrender.io import bounded_files
from unrender.rendering.mitsuba import description as loading
from unrender.rendering.mitsuba import emissive, turntable_light
from unrender.rendering.mitsuba.equal_objects import equal_objects
from unrender.rendering.mitsuba.grid_transforms import attached_media

__all__ = ["SceneDescription", "is_loaded", "load", "load_resolved", "media"]

SceneDescription = str | Path | dict | Callable[[], Any] | Any
"""An XML file, a Mitsuba dictionary, or a function that returns one (called twice, so that ready-made objects such as
meshes are made twice); or a loaded `mi.Scene`, of which there is one state only."""


def load(description: SceneDescription) -> mi.Scene:
    """One Mitsuba scene. Meshes are not merged, so that two loads have their shapes in the same order.

    Raises `InputError` in one line where the file is missing or Mitsuba refuses the description.
    """
    return load_resolved(description)[0]


def is_loaded(description: SceneDescription) -> bool:
    """Whether it is a scene in memory, of any variant, and no description of one."""
    return type(description).__module__.partition(".")[0] == "mitsuba" and type(description).__name__ == "Scene"


def load_resolved(description: SceneDescription) -> tuple[mi.Scene, Path | dict, tuple[tuple[str, ...], ...]]:
    """As `load`, and what was loaded: the file's path, or the dictionary without data (`_outline`); nothing in it for a scene that was
    loaded before. And the names of its `equal_objects`."""
    variant.ensure()
    emissive.register()
    turntable_light.register()
    if is_loaded(description):
        return _loaded_before(description), {}, ()
    if callable(description):
        description = description()
    name = str(description) if isinstance(description, (str, Path)) else "dictionary"
    try:
        if isinstance(description, (str, Path)):
            path = Path(description)
            if bounded_files.kind(path) != "file":
                raise InputError(f"scene {path}: {bounded_files.no_file(path)}")
            parsed = loading.parse(path)
        elif isinstance(description, dict):
            parsed = loading.parse(description)
        else:
            raise InputError(f"scene: expected an .xml path or a Mitsuba dictionary, got {type(description).__name__}")
        equal = equal_objects(parsed.state.nodes)
        scene = parsed.instantiate()
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith("scene") else f"scene {name}: {text}") from error
    except Exception as error:
        raise InputError(f"scene {name}: Mitsuba could not load it: {_one_line(error)}") from error
    if not isinstance(scene, mi.Scene):
        raise InputError(f"scene: the description makes a {type(scene).__name__}, not a scene")
    outline = _outline(description) if isinstance(description, dict) else Path(description)
    return _with_sensor(scene), outline, equal


def _outline(description: dict[str, Any]) -> dict[str, Any]:
    """A dictionary without the grids, bitmaps and arrays in memory that it hands to plugins: the scene has copies of them."""
    found = {key: _outline(value) if isinstance(value, dict) else value for key, value in description.items()}
    return {key: value for key, value in found.items() if not _is_data(value)}


def _is_data(value: Any) -> bool:
    large = isinstance(value, np.ndarray) and value.size > 16  # no transform
    return large or isinstance(value, (mi.VolumeGrid, mi.Bitmap)) or dr.is_tensor_v(value)


def _loaded_before(scene: Any) -> mi.Scene:
    if not isinstance(scene, mi.Scene):
        raise InputError(
            f"scene: it was loaded under another variant than {mi.variant()}; call unrender.use() before loading it"
        )
    return _with_sensor(scene)


def _with_sensor(scene: mi.Scene) -> mi.Scene:
    if not scene.sensors():
        raise InputError("scene: it has no sensor, and nothing can be rendered without one")
    return scene


def _one_line(error: Exception) -> str:
    if own := re.search(r"InputError: (.+)", str(error)):  # of a plugin of ours, under Mitsuba's traceback
        return own[1]
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines)[:400] or type(error).__name__


def media(scene: mi.Scene) -> list[mi.Medium]:
    """All participating media of a scene, once for each place they are in, in an order that two loads share."""
    return [medium for _, medium in attached_media(scene)]
