"""The edges of all meshes of a scene, where visibility changes when geometry moves.

Which edge borders on which face is found once; positions are read from the scene whenever they are asked for, with their derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba import mesh_layout

__all__ = ["EdgePoints", "EdgeTable", "MeshEdges", "edges_of"]


@dataclass(frozen=True)
class MeshEdges:
    """Of one mesh: two ends, the third corner of two adjacent faces (E,), and whether the edge is one."""

    ends: np.ndarray
    thirds: np.ndarray
    always: np.ndarray
    crease: np.ndarray


class EdgePoints:
    """Edges, gathered per lane. No dataclass: Dr.Jit would take it for state of its loops.

    Attributes:
        start, end: `mi.Point3f`, attached where the caller resumes gradients.
        third, other_third: `mi.Point3f`, the opposite corners of two adjacent faces, the same one where there is one face only; detached.
        always: whether it may be a silhouette from everywhere: at the border of a mesh, or with more than two faces.
        crease: whether the shading is discontinuous across it.
    """

    def __init__(self, start: Any, end: Any, third: Any, other_third: Any, always: Any, crease: Any):
        self.start, self.end, self.third, self.other_third = start, end, third, other_third
        self.always, self.crease = always, crease

    def sides(self, direction: Any) -> tuple[Any, Any]:
        """On which sides of the plane through the edge and `direction` the two faces lie: two signed distances, detached."""
        start = dr.detach(self.start)
        normal = dr.cross(dr.detach(self.end) - start, direction)
        return dr.dot(normal, self.third - start), dr.dot(normal, self.other_third - start)

    def is_silhouette(self, direction: Any) -> Any:
        """Whether the faces lie on one side of it, seen along `direction`."""
        one, other = self.sides(direction)
        return self.always | (one * other > 0)


class EdgeTable:
    """The edges of all meshes of a scene.

    Vertices at the same place count as one when faces are matched, so that seams of texture coordinates are no borders. Triangles
    without area have no edges of their own.

    Args:
        scene: `mi.Scene`.
        moving: ids of the shapes that move.
        loaded: {id: positions (3 V,)} to match faces by, where a mesh may hold others by now.

    Attributes:
        count: of edges, those of moving shapes first.
        moving: how many are of moving shapes.
    """

    def __init__(self, scene: Any, moving: AbstractSet[str], loaded: Mapping[str, np.ndarray] | None = None):
        meshes = [shape for shape in scene.shapes() if shape.is_mesh()]
        self._order = [mesh.id() for mesh in sorted(meshes, key=lambda mesh: mesh.id() not in moving)]
        by_id = {mesh.id(): mesh for mesh in meshes}
        none = np.zeros((0, 2), np.uint32)
        parts: list[tuple[MeshEdges, int]] = [(MeshEdges(none, none, np.zeros(0, bool), np.zeros(0, bool)), 0)]
        first = 0
        self.moving = 0
        for name in self._order:
            mesh = by_id[name]
            found = edges_of(mesh, (loaded or {}).get(name))
            parts.append((found, first))
            first += dr.width(mesh_layout.positions(mesh)) // 3
            if name in moving:
                self.moving += len(found.always)
        ends = np.concatenate([part.ends + offset for part, offset in parts])
        thirds = np.concatenate([part.thirds + offset for part, offset in parts])
        self.count = len(ends)
        self._ends = mi.UInt32(ends[:, 0]), mi.UInt32(ends[:, 1])
        self._thirds = mi.UInt32(thirds[:, 0]), mi.UInt32(thirds[:, 1])
        self._always = mi.Bool(np.concatenate([part.always for part, _ in parts]))
        self._crease = mi.Bool(np.concatenate([part.crease for part, _ in parts]))

    def positions(self, scene: Any) -> Any:
        """The vertices of all meshes, one behind the other, `mi.Float`; attached where the caller resumes gradients."""
        by_id = {shape.id(): shape for shape in scene.shapes() if shape.is_mesh()}
        return dr.concat([mesh_layout.positions(by_id[name]) for name in self._order])

    def at(self, positions: Any, index: Any, active: Any = True) -> EdgePoints:
        """The edges of these numbers."""
        ends, thirds = (
            [dr.gather(mi.UInt32, column, index, active) for column in pair] for pair in (self._ends, self._thirds)
        )
        start, end = (dr.gather(mi.Point3f, positions, number, active) for number in ends)
        with dr.suspend_grad():
            third, other = (dr.gather(mi.Point3f, positions, number, active) for number in thirds)
        always, crease = (dr.gather(mi.Bool, flags, index, active) for flags in (self._always, self._crease))
        return EdgePoints(start, end, dr.detach(third), dr.detach(other), always, crease)


def edges_of(mesh: Any, positions: np.ndarray | None) -> MeshEdges:
    """The edges of a mesh, each once."""
    points = np.array(mesh_layout.positions(mesh) if positions is None else positions).reshape(-1, 3)
    faces = np.array(mesh_layout.faces(mesh)).reshape(-1, 3).astype(np.int64)
    _, welded = np.unique(points, axis=0, return_inverse=True)
    welded = welded.reshape(-1)
    a, b, c = (points[faces[:, corner]].astype(float) for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners = welded[faces]
    distinct = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    faces = faces[distinct & (area > 0)]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    thirds = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    names = welded[ends]
    turned = names[:, 0] > names[:, 1]
    ends[turned], names[turned] = ends[turned][:, ::-1], names[turned][:, ::-1]
    order = np.lexsort((names[:, 1], names[:, 0]))
    ends, thirds, names = ends[order], thirds[order], names[order]
    first = np.flatnonzero(np.r_[True, (names[1:] != names[:-1]).any(axis=1)]) if len(names) else np.zeros(0, np.int64)
    faces_at = np.diff(np.r_[first, len(names)])
    second = first + (faces_at > 1)
    flat = bool(mesh.has_face_normals() or not mesh_layout.has_normals(mesh))
    torn = (ends[first] != ends[second]).any(axis=1)
    thirds = np.stack([thirds[first], thirds[second]], axis=-1)
    return MeshEdges(ends[first], thirds, faces_at != 2, (torn | flat) & (faces_at > 1))
