"""Conversion of scene dictionaries with ready-made Mitsuba objects to dictionaries that refer to files.

A mesh, a bitmap or a grid is written to a file. The description of a material is known if `load_described` created it; that of a plain
diffuse material is read from the object.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.io import images
from unrender.io.volumes import write_grid
from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.description import Recorded, recorded_descriptions

BITMAPS, VOLUMES, MESHES = "textures", "volumes", "meshes"
"""Names of the sub-folders of the files of a scene."""


def make(description: Callable[[], Any]) -> tuple[Any, Recorded]:
    """Return the result of `description()`, and the objects that it created by `load_described`, with their descriptions."""
    with recorded_descriptions() as recorded:
        return description(), recorded


class FilesOnly:
    """A converter of a scene dictionary, which writes ready-made objects to files in sub-folders; `recorded` are the results of `make`."""

    def __init__(self, folder: Path, recorded: Recorded):
        self._folder = folder
        self._recorded = recorded
        self._placed: list[tuple[Any, str]] = []

    def dictionary(self, description: Mapping[str, Any], place: tuple[str, ...] = ()) -> dict[str, Any]:
        """Return the description with files in place of objects. Raises `InputError` if an object has no description."""
        converted: dict[str, Any] = {}
        for key, value in description.items():
            here = (*place, key)
            if isinstance(value, Mapping):
                converted[key] = self.dictionary(value, here)
            elif isinstance(value, mi.VolumeGrid) or (key == "data" and description.get("type") == "gridvolume"):
                converted["filename"] = self._volume(value, here)
            elif isinstance(value, mi.Bitmap) or (key == "data" and description.get("type") in ("bitmap", "envmap")):
                converted["filename"] = self._bitmap(value, here)
            elif isinstance(value, mi.Object):
                converted[key] = self._object(value, here)
            else:
                converted[key] = value
        return converted

    def _object(self, value: Any, place: tuple[str, ...]) -> dict[str, Any]:
        for other, name in self._placed:
            if other is value:
                return {"type": "ref", "id": name}
        self._placed.append((value, ".".join(place)))
        if isinstance(value, mi.Mesh):
            return self._mesh(value, place)
        description = next((known for made, known in self._recorded if made is value), None)
        if description is None and isinstance(value, mi.BSDF):
            description = diffuse_description(value)
        if description is None:
            raise InputError(
                f"{'.'.join(place)}: a ready-made {value.class_name()}, which has no description; give its dictionary, or "
                "make it by unrender.rendering.mitsuba.description.load_described inside the function that returns the scene"
            )
        return self.dictionary(description, place)

    def _mesh(self, mesh: Any, place: tuple[str, ...]) -> dict[str, Any]:
        path = new_file(self._folder, MESHES, ".".join(place), ".ply")
        mesh.write_ply(str(path))
        description: dict[str, Any] = {"type": "ply", "filename": str(path)}
        if mesh.id() and mesh.id() != place[-1]:
            description["id"] = mesh.id()
        if not mesh_layout.has_normals(mesh):
            description["face_normals"] = True  # otherwise Mitsuba computes vertex normals
        for name, part in (("bsdf", mesh.bsdf()), ("emitter", mesh.emitter())):
            if part is not None:
                description[name] = self._object(part, (*place, name))
        return description

    def _bitmap(self, value: Any, place: tuple[str, ...]) -> str:
        bitmap = value if isinstance(value, mi.Bitmap) else None
        eight = bitmap is not None and bitmap.component_format() in (mi.Struct.Type.UInt8, mi.Struct.Type.UInt16)
        path = new_file(self._folder, BITMAPS, ".".join(place[:-1]), ".png" if eight else ".exr")
        images.write(np.array(value) if bitmap is None else bitmap, path)
        return str(path)

    def _volume(self, value: Any, place: tuple[str, ...]) -> str:
        path = new_file(self._folder, VOLUMES, ".".join(place[:-1]), ".vol")
        return str(write_grid(path, value if isinstance(value, mi.VolumeGrid) else np.array(value, np.float32)))


def diffuse_description(bsdf: Any) -> dict[str, Any] | None:
    """Return the description of a diffuse material of one colour, one- or two-sided; None for other materials.

    The parameters of other materials do not include all of their settings (distributions, filters).
    """
    parameters = mi.traverse(bsdf)
    if bsdf.class_name() == "TwoSidedBRDF":
        sides = {}
        for side in ("brdf_0", "brdf_1"):
            key = f"{side}.reflectance.value"
            owner = parameters.hierarchy[parameters.properties[key][2]][0] if key in parameters else None
            if owner is not None and (inner := _diffuse(owner, parameters, key)):
                sides[side] = inner
        count = len({key.split(".")[0] for key in parameters.keys()})  # noqa: SIM118
        return {"type": "twosided", **sides} if sides and len(sides) == count else None
    return _diffuse(bsdf, parameters, "reflectance.value")


def _diffuse(bsdf: Any, parameters: Any, key: str) -> dict[str, Any] | None:
    if bsdf.class_name() != "SmoothDiffuse" or key not in parameters:
        return None
    value: Any = parameters[key]
    flat = [float(x) for x in np.array(value).ravel()]
    kind = parameters.properties[key][2].class_name()
    if kind == "UniformSpectrum" and len(flat) == 1:
        return {"type": "diffuse", "reflectance": flat[0]}
    if kind == "SRGBReflectanceSpectrum" and len(flat) == 3:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": flat}}
    return None


def new_file(folder: Path, kind: str, name: str, ending: str) -> Path:
    """Return the path of a file in a sub-folder (`BITMAPS`, `VOLUMES`, `MESHES`), which is created."""
    path = folder / kind / (file_name(name) + ending)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def file_name(text: str) -> str:
    """Return `text` as a file name without extension: letters, digits, dots, hyphens and underscores."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip(".-")[:100] or "unnamed"
