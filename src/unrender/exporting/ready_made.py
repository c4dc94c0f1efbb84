"""Scene dictionaries that hold ready-made Mitsuba objects, turned into ones that name files.

A mesh, a bitmap or a grid goes to a file as it is. A material cannot be read back off its object; but whoever made it called
`mitsuba.load_dict`, so descriptions are listened for while a function makes its dictionary.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.io.volumes import write_grid

BITMAPS, VOLUMES, MESHES = "textures", "volumes", "meshes"
"""The folders of a scene's files."""


def listen(make: Callable[[], Any]) -> tuple[Any, list[tuple[Any, dict[str, Any]]]]:
    """What `make()` returns, and every object that it made by `mitsuba.load_dict` with its description."""
    heard: list[tuple[Any, dict[str, Any]]] = []
    load = mi.load_dict

    def listening(description: dict[str, Any], *arguments: Any, **options: Any) -> Any:
        made = load(description, *arguments, **options)
        heard.append((made, description))
        return made

    mi.load_dict = listening
    try:
        return make(), heard
    finally:
        mi.load_dict = load


class FilesOnly:
    """Walks a scene dictionary and writes what is no plain value to files.

    Args:
        folder: where the files go, in sub-folders.
        heard: of `listen`.
    """

    def __init__(self, folder: Path, heard: list[tuple[Any, dict[str, Any]]]):
        self._folder = folder
        self._heard = heard
        self._placed: list[tuple[Any, str]] = []

    def dictionary(self, given: Mapping[str, Any], place: tuple[str, ...] = ()) -> dict[str, Any]:
        """`given` with files in place of objects. Raises `InputError` for an object that has no description."""
        found: dict[str, Any] = {}
        for key, value in given.items():
            here = (*place, key)
            if isinstance(value, Mapping):
                found[key] = self.dictionary(value, here)
            elif isinstance(value, mi.VolumeGrid) or (key == "data" and given.get("type") == "gridvolume"):
                found["filename"] = self._volume(value, here)
            elif isinstance(value, mi.Bitmap) or (key == "data" and given.get("type") in ("bitmap", "envmap")):
                found["filename"] = self._bitmap(value, here)
            elif isinstance(value, mi.Object):
                found[key] = self._object(value, here)
            else:
                found[key] = value
        return found

    def _object(self, value: Any, place: tuple[str, ...]) -> dict[str, Any]:
        for other, name in self._placed:
            if other is value:
                return {"type": "ref", "id": name}
        self._placed.append((value, ".".join(place)))
        if isinstance(value, mi.Mesh):
            return self._mesh(value, place)
        description = next((told for made, told in self._heard if made is value), None)
        if description is None:
            raise InputError(
                f"{'.'.join(place)}: a ready-made {value.class_name()}, which tells no description of itself; make it by "
                "mitsuba.load_dict inside the function that returns the scene, or give its dictionary"
            )
        return self.dictionary(description, place)

    def _mesh(self, mesh: Any, place: tuple[str, ...]) -> dict[str, Any]:
        path = self._path(MESHES, place, ".ply")
        mesh.write_ply(str(path))
        found: dict[str, Any] = {"type": "ply", "filename": str(path)}
        if mesh.id() and mesh.id() != place[-1]:
            found["id"] = mesh.id()
        if not mesh.has_vertex_normals():
            found["face_normals"] = True  # or Mitsuba makes some up
        for name, part in (("bsdf", mesh.bsdf()), ("emitter", mesh.emitter())):
            if part is not None:
                found[name] = self._object(part, (*place, name))
        return found

    def _bitmap(self, value: Any, place: tuple[str, ...]) -> str:
        bitmap = value if isinstance(value, mi.Bitmap) else as_bitmap(np.array(value))
        eight = bitmap.component_format() in (mi.Struct.Type.UInt8, mi.Struct.Type.UInt16)
        path = self._path(BITMAPS, place[:-1], ".png" if eight else ".exr")
        bitmap.write(str(path))
        return str(path)

    def _volume(self, value: Any, place: tuple[str, ...]) -> str:
        path = self._path(VOLUMES, place[:-1], ".vol")
        return str(write_grid(path, value if isinstance(value, mi.VolumeGrid) else np.array(value, np.float32)))

    def _path(self, kind: str, place: tuple[str, ...], ending: str) -> Path:
        path = self._folder / kind / (file_name(".".join(place)) + ending)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def as_bitmap(values: np.ndarray) -> Any:
    """A float32 bitmap of (H, W) or (H, W, C) with C of 1, 3 or 4."""
    pixels = np.ascontiguousarray(values if values.ndim == 3 else values[..., None], np.float32)
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4):
        raise InputError(f"no picture has {values.shape[-1]} channels; expected 1, 3 or 4")
    return mi.Bitmap(pixels)


def file_name(text: str) -> str:
    """`text` as a file's name without its ending: letters, digits, dots, hyphens and underscores."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip(".-")[:100] or "unnamed"
