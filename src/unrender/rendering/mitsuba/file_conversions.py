"""What Mitsuba makes of a file: the conversions of its textures and environment maps, and the vertices of its meshes."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.io import bounded_files
from unrender.io.file_conversion import PLAIN, FileConversion
from unrender.rendering.mitsuba import description as loading
from unrender.rendering.mitsuba.scene_loading import SceneDescription, is_loaded

__all__ = ["conversion", "read_vertices"]

_RAW = re.compile(r"^\s*raw = (1|true)\b", re.MULTILINE)
_ENVIRONMENT_COLUMNS = 1
"""Columns that Mitsuba adds at each end of an environment map, and copies anew whenever its data change."""
_KEPT = ("to_world", "face_normals", "flip_normals", "flip_tex_coords")
_INDEXED = "serialized"


def conversion(parameters: mi.SceneParameters, key: str, description: SceneDescription) -> FileConversion:
    """Return how Mitsuba converts a file to the values of the parameter `key`.

    Args:
        parameters: of the loaded scene.
        key: of a parameter that is an array.
        description: what the scene was loaded from; its shapes place the vertices of mesh files.
    """
    value, node = parameters[key], parameters.properties[key][2]
    if isinstance(node, mi.Mesh) and key.rpartition(".")[2].startswith("vertex_"):
        return FileConversion(vertices=partial(read_vertices, description, key))
    if not key.endswith("data") or not dr.is_tensor_v(value):
        return PLAIN
    columns = _ENVIRONMENT_COLUMNS if node.class_name() == "EnvironmentMapEmitter" else 0
    raw = isinstance(node, mi.Texture) and _RAW.search(str(node)) is not None
    return FileConversion(raw, dr.type_v(value) == dr.VarType.Float16, columns)


def read_vertices(description: SceneDescription, key: str, path: Path) -> np.ndarray:
    """Return values at the vertices of a mesh file, as if the scene's shape named that file.

    Mitsuba loads the file: with the shape's transform, its own order of vertices, and the duplicates that it makes for normals and
    texture coordinates.

    Args:
        description: of the scene.
        key: such as "block.vertex_positions".
        path: of an .obj, .ply or .serialized file.

    Returns:
        (n V,) float32.

    Raises:
        InputError: the file cannot be read or has no such values, or the scene does not tell how its shape is placed.
    """
    if bounded_files.kind(path) != "file":
        raise InputError(f"{path}: {bounded_files.no_file(path)}")
    owner, _, name = key.rpartition(".")
    given: Any = description() if callable(description) else description
    if is_loaded(given):
        raise InputError(
            f"{path}: a loaded scene does not tell how its shapes are placed; give the .xml file or an array"
        )
    parsed = loading.parse(Path(given) if isinstance(given, (str, Path)) else given)
    shape = next((node.props for node in parsed.state.nodes if node.props.id() == owner), None)
    if shape is None:
        raise InputError(f"{path}: the scene's description has no shape of the name {owner}; give an array")
    plugin = path.suffix.lower().removeprefix(".")
    named: dict[str, Any] = {"type": plugin, "filename": str(path.resolve())}
    named |= {option: shape[option] for option in _KEPT if option in shape}
    if plugin == _INDEXED and "shape_index" in shape:
        named["shape_index"] = shape["shape_index"]
    try:
        values = mi.traverse(loading.load(named))
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    except RuntimeError as error:
        raise InputError(f"{path}: Mitsuba could not load it: {' '.join(str(error).split())[:200]}") from error
    if name not in values:
        raise InputError(f"{path}: the mesh has no {name}")
    return np.array(values[name], np.float32).reshape(-1)
