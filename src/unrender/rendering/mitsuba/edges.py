"""Edges of all meshes of a scene, the candidates for visibility discontinuities.

The adjacency of edges and faces is computed once. Positions are read from the scene at each use, with their derivatives.
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


@dataclass(frozen=True)
class MeshEdges:
    """Edges of one mesh.

    Attributes:
        ends: vertex indices of both ends, (E, 2).
        thirds: index of the opposite vertex of two adjacent faces, (E, 2).
        always, crease: see `EdgePoints`, (E,).
    """

    ends: np.ndarray
    thirds: np.ndarray
    always: np.ndarray
    crease: np.ndarray


class EdgePoints:
    """Edges gathered per lane. This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.

    Attributes:
        start, end: `mi.Point3f`, attached if the caller resumes gradients.
        third, other_third: `mi.Point3f`, opposite corners of two adjacent faces, equal if there is only one face; detached.
        always: whether it may be a silhouette from every direction: at the border of a mesh, or with more than two faces.
        crease: whether shading is discontinuous across the edge.
    """

    def __init__(self, start: Any, end: Any, third: Any, other_third: Any, always: Any, crease: Any):
        self.start, self.end, self.third, self.other_third = start, end, third, other_third
        self.always, self.crease = always, crease

    def sides(self, direction: Any) -> tuple[Any, Any]:
        """Return on which side of the plane through the edge and `direction` each face lies: two signed distances, detached."""
        start = dr.detach(self.start)
        normal = dr.cross(dr.detach(self.end) - start, direction)
        return dr.dot(normal, self.third - start), dr.dot(normal, self.other_third - start)

    def is_silhouette(self, direction: Any) -> Any:
        """Return whether both faces lie on the same side of the edge, seen along `direction`."""
        one, other = self.sides(direction)
        return self.always | (one * other > 0)


class EdgeTable:
    """Edges of all meshes of a scene.

    Vertices at the same position are merged to match faces, so seams of texture coordinates are not borders. Triangles without area
    have no edges.

    Args:
        scene: `mi.Scene`.
        moving: ids of the shapes that move.
        loaded: {id: positions (3 V,)} to match faces by, if a mesh may have other positions by now.

    Attributes:
        count: number of edges; those of moving shapes come first.
        moving: number of edges of moving shapes.
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
            edges = edges_of(mesh, (loaded or {}).get(name))
            parts.append((edges, first))
            first += dr.width(mesh_layout.positions(mesh)) // 3
            if name in moving:
                self.moving += len(edges.always)
        ends = np.concatenate([part.ends + offset for part, offset in parts])
        thirds = np.concatenate([part.thirds + offset for part, offset in parts])
        self.count = len(ends)
        self._ends = mi.UInt32(ends[:, 0]), mi.UInt32(ends[:, 1])
        self._thirds = mi.UInt32(thirds[:, 0]), mi.UInt32(thirds[:, 1])
        self._always = mi.Bool(np.concatenate([part.always for part, _ in parts]))
        self._crease = mi.Bool(np.concatenate([part.crease for part, _ in parts]))

    def positions(self, scene: Any) -> Any:
        """Return the concatenated vertices of all meshes, `mi.Float`; attached if the caller resumes gradients."""
        by_id = {shape.id(): shape for shape in scene.shapes() if shape.is_mesh()}
        return dr.concat([mesh_layout.positions(by_id[name]) for name in self._order])

    def at(self, positions: Any, index: Any, active: Any = True) -> EdgePoints:
        """Return the edges of these indices."""
        ends, thirds = (
            [dr.gather(mi.UInt32, column, index, active) for column in pair] for pair in (self._ends, self._thirds)
        )
        start, end = (dr.gather(mi.Point3f, positions, number, active) for number in ends)
        with dr.suspend_grad():
            third, other = (dr.gather(mi.Point3f, positions, number, active) for number in thirds)
        always, crease = (dr.gather(mi.Bool, flags, index, active) for flags in (self._always, self._crease))
        return EdgePoints(start, end, dr.detach(third), dr.detach(other), always, crease)


def edges_of(mesh: Any, positions: np.ndarray | None) -> MeshEdges:
    """Return the edges of a mesh, each once."""
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
