"""Meshes of a loaded scene that are given other vertices and faces than its files have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.renderer import ReplacedMesh

__all__ = ["replace_meshes"]


def replace_meshes(scene: Any, meshes: Mapping[str, ReplacedMesh]) -> None:
    """Give shapes of a scene, by their ids, other meshes. Raises `InputError` where a shape is none, or texture coordinates are missing."""
    if not meshes:
        return
    parameters = mi.traverse(scene)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    for name, mesh in meshes.items():
        shape = shapes.get(name)
        if shape is None or not shape.is_mesh():
            raise InputError(f"{name}: no mesh of the scene")
        if shape.has_vertex_texcoords() != (mesh.uv is not None):
            raise InputError(f"{name}: texture coordinates are missing, or the mesh has none")
        parameters[f"{name}.faces"] = mi.UInt32(mesh.faces.ravel().astype(np.uint32))
        parameters[f"{name}.vertex_positions"] = mi.Float(mesh.vertices.ravel().astype(np.float32))
        if mesh.uv is not None:
            parameters[f"{name}.vertex_texcoords"] = mi.Float(mesh.uv.ravel().astype(np.float32))
    parameters.update()
