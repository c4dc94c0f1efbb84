"""The only module that depends on Mitsuba's mesh layout.

Up to Mitsuba 3.9 a mesh has flat arrays: `vertex_positions` (3 V,), `vertex_normals` (3 V,), `vertex_texcoords` (2 V,) and `faces` (3
F,). From 3.10 on it has tensors: `positions` (P, 3), `normals` (N, 3), `texcoords` (V, 2) and `faces` (F, 3), with maps from vertices
to positions and normals, so that vertices on both sides of a seam share a position. This package uses the keys and values of 3.9:
`parameters` and `traverse` translate both, and the functions below read a mesh of either layout.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

POSITIONS, NORMALS, TEXCOORDS, FACES = "vertex_positions", "vertex_normals", "vertex_texcoords", "faces"
_RENAMED = {"positions": POSITIONS, "normals": NORMALS, "texcoords": TEXCOORDS}
"""{name from Mitsuba 3.10 on: name in this package}."""


def _has_tensors(mesh: Any) -> bool:
    """Return whether a mesh, or the class of meshes, has the layout of Mitsuba 3.10."""
    return "geometric_faces" in dir(mesh)


# ------------------------------------------------------------------ parameters


def traverse(node: Any) -> Any:
    """Return `mitsuba.traverse(node)` with the names and flat arrays of this package."""
    params: Any = mi.traverse(node)
    return parameters(params.properties, params.hierarchy)


def parameters(properties: dict[str, Any], hierarchy: dict[Any, Any]) -> Any:
    """Return the `mitsuba.SceneParameters` of traversed objects, with the names and flat arrays of this package."""
    named: dict[Any, set[str]] = {}
    for key, entry in properties.items():
        named.setdefault(entry[2], set()).add(key.rpartition(".")[2])
    meshes = {node for node, names in named.items() if {"positions", FACES} <= names}
    return _flat(mi.variant())(properties, hierarchy, meshes) if meshes else mi.SceneParameters(properties, hierarchy)


@cache
def _flat(_variant: str) -> type:
    """Return the class for the layout of Mitsuba 3.10. It is created per variant, since its base class depends on the variant."""

    class FlatMeshes(mi.SceneParameters):
        """Scene parameters in which the tensors of meshes are flat arrays."""

        def __init__(self, properties: Mapping[str, Any], hierarchy: dict[Any, Any], meshes: set[Any]):
            self.originals: dict[str, str] = {}
            renamed = {}
            for key, entry in properties.items():
                owner, dot, leaf = key.rpartition(".")
                if entry[2] in meshes:
                    key = f"{owner}{dot}{_RENAMED.get(leaf, leaf)}"
                    self.originals[key] = leaf
                renamed[key] = entry
            super().__init__(renamed, hierarchy)

        def __getitem__(self, key: str) -> Any:
            value: Any = super().__getitem__(key)
            return value.array if self._is_flat(key, value) else value

        def __setitem__(self, key: str, value: Any) -> None:
            held: Any = super().__getitem__(key)
            if self._is_flat(key, held) and not dr.is_tensor_v(value):
                width = held.shape[1]
                value = type(held)(type(held.array)(value), (dr.width(value) // width, width))
            super().__setitem__(key, value)

        def set_dirty(self, key: str) -> Any:
            """Mark a parameter as changed, under the mesh's original name."""
            entry = super().set_dirty(key)
            if key in self.originals:
                node = entry[2]
                names = self.nodes_to_update[self.hierarchy[node][1], node]
                names.discard(key.rpartition(".")[2])
                names.add(self.originals[key])
            return entry

        def _is_flat(self, key: str, value: Any) -> bool:
            return key in self.originals and dr.is_tensor_v(value) and value.ndim == 2

    return FlatMeshes


# ------------------------------------------------------------------ meshes


def positions(mesh: Any) -> Any:
    """Return the positions of a mesh, flat, `mi.Float` (3 P,), attached to the derivative graph."""
    return mi.Float(mesh.positions().array if _has_tensors(mesh) else mesh.vertex_positions_buffer())


def faces(mesh: Any) -> Any:
    """Return the position indices of each triangle, flat, `mi.UInt32` (3 F,)."""
    return mi.UInt32(mesh.geometric_faces().array if _has_tensors(mesh) else mesh.faces_buffer())


def at_vertices(mesh: Any, points: np.ndarray) -> np.ndarray:
    """Return the position of each vertex, (V, 3), from positions (P, 3). Vertices on both sides of a seam may share one."""
    index = np.array(mesh.position_index()) if _has_tensors(mesh) else np.zeros(0, np.uint32)
    return points[index] if index.size else points


def vertex_positions(mesh: Any) -> np.ndarray:
    """Return the position of each vertex, (V, 3)."""
    return at_vertices(mesh, np.array(positions(mesh)).reshape(-1, 3))


def areas(mesh: Any) -> Any:
    """Return twice the area of each triangle of a mesh, (F,)."""
    corners = dr.unravel(mi.Point3u, faces(mesh))
    a, b, c = (dr.gather(mi.Point3f, positions(mesh), corner) for corner in corners)
    return dr.norm(dr.cross(b - a, c - a))


def has_normals(mesh: Any) -> bool:
    """Return whether a mesh has normals at its vertices."""
    return bool(mesh.has_normals() if _has_tensors(mesh) else mesh.has_vertex_normals())


def has_texcoords(mesh: Any) -> bool:
    """Return whether a mesh has texture coordinates at its vertices."""
    return bool(mesh.has_texcoords() if _has_tensors(mesh) else mesh.has_vertex_texcoords())


def build(
    name: str,
    points: np.ndarray,
    triangles: np.ndarray,
    normals: np.ndarray | None = None,
    texcoords: np.ndarray | None = None,
    bsdf: Any = None,
) -> Any:
    """Return a new mesh with the given normals (V, 3), or smooth ones that Mitsuba computes. The name is for messages. The id is set by the
    scene's description, since two objects may hold meshes of one name."""
    arrays = {
        POSITIONS: np.ascontiguousarray(points, np.float32),
        NORMALS: None if normals is None else np.ascontiguousarray(normals, np.float32),
        TEXCOORDS: None if texcoords is None else np.ascontiguousarray(texcoords, np.float32),
    }
    corners = np.ascontiguousarray(triangles, np.uint32)
    if _has_tensors(mi.Mesh):
        tensors = {new: mi.TensorXf(arrays[old]) for new, old in _RENAMED.items() if arrays[old] is not None}
        mesh: Any = mi.Mesh(name, faces=mi.TensorXu(corners), **tensors)  # pyright: ignore[reportCallIssue]
        if bsdf is not None:
            mesh.set_bsdf(bsdf)
    else:
        properties = mi.Properties()
        if bsdf is not None:
            properties["bsdf"] = bsdf
        textured = texcoords is not None
        mesh = mi.Mesh(
            name, len(points), len(corners), properties, has_vertex_normals=True, has_vertex_texcoords=textured
        )
        _fill(mesh, {FACES: corners, POSITIONS: arrays[POSITIONS], TEXCOORDS: arrays[TEXCOORDS]})
        # Normals need a second update: Mitsuba recomputes them whenever positions change.
        _fill(mesh, {NORMALS: arrays[NORMALS]})
    return mesh


def _fill(mesh: Any, values: Mapping[str, np.ndarray | None]) -> None:
    params: Any = mi.traverse(mesh)
    for name, value in values.items():
        if value is not None:
            params[name] = (mi.UInt32 if name == FACES else mi.Float)(value.ravel())
    params.update()
