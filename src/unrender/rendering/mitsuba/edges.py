"""Edges of all meshes of a scene, the candidates for visibility discontinuities; and meshes in place of moving spheres, which have none.

The adjacency of edges and faces is computed once. Positions are read from the scene at each use, with their derivatives.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.backend import variant
from unrender.core.geometry import weld
from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.integrators.base import registry_id
from unrender.rendering.mitsuba.scene_graph import ObjectGraph, scene_of


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

    Start and end are attached if the caller resumes gradients; opposite corners are detached, and equal if there is only one face.
    `always`: an edge at a border or of more than two faces. `crease`: shading is discontinuous across it.
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
    """Edges of all meshes of a scene: `count` in all, first the `moving` ones, of shapes that move.

    Vertices at the same position are merged to match faces, so seams of texture coordinates are not borders. `loaded` has positions {id: (3
    V,)} to match faces by, if a mesh may have other ones by now. Triangles without area have no edges. `lit`: a moving shape emits light.
    """

    def __init__(self, scene: Any, moving: AbstractSet[str], loaded: Mapping[str, np.ndarray] | None = None):
        meshes = [shape for shape in scene.shapes() if shape.is_mesh()]
        self._order = [mesh.id() for mesh in sorted(meshes, key=lambda mesh: mesh.id() not in moving)]
        by_id, self._moving = {mesh.id(): mesh for mesh in meshes}, moving
        none = np.zeros((0, 2), np.uint32)
        parts: list[tuple[MeshEdges, int]] = [(MeshEdges(none, none, np.zeros(0, bool), np.zeros(0, bool)), 0)]
        first = 0
        self.moving, self.lit = 0, any(mesh.is_emitter() and mesh.id() in moving for mesh in meshes)
        for name in self._order:
            mesh = by_id[name]
            edges = edges_of(mesh, (loaded or {}).get(name))
            parts.append((edges, first))
            first += dr.width(mesh_layout.positions(mesh)) // 3
            if name in moving:
                self.moving += len(edges.always)
        ends = np.concatenate([part.ends + offset for part, offset in parts])
        thirds = np.concatenate([part.thirds + offset for part, offset in parts])
        self.count, self._counts = len(ends), [len(part.ends) for part, _ in parts[1:]]
        self._ends = mi.UInt32(ends[:, 0]), mi.UInt32(ends[:, 1])
        self._thirds = mi.UInt32(thirds[:, 0]), mi.UInt32(thirds[:, 1])
        self._always = mi.Bool(np.concatenate([part.always for part, _ in parts]))
        self._crease = mi.Bool(np.concatenate([part.crease for part, _ in parts]))

    def positions(self, scene: Any) -> Any:
        """Return the concatenated vertices of all meshes, `mi.Float`; attached if the caller resumes gradients."""
        by_id = {shape.id(): shape for shape in scene.shapes() if shape.is_mesh()}
        return dr.concat([mesh_layout.positions(by_id[name]) for name in self._order])

    def moving_emitters(self, scene: Any) -> Any:
        """Return the registry id of the emitter that moves with each edge, 0 for none, `mi.UInt32` (count,)."""
        by_id = {shape.id(): shape for shape in scene.shapes() if shape.is_mesh()}
        lamps = [by_id[name].emitter() if name in self._moving else None for name in self._order]
        numbers = [0 if lamp is None else int(registry_id(mi.EmitterPtr(lamp))[0]) for lamp in lamps]
        return mi.UInt32(np.repeat(np.array(numbers, np.uint32), self._counts))

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
    _, welded = weld(points)
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


_ROWS, _COLUMNS = 64, 128
"""Rows and columns of the mesh. Its silhouette deviates from the sphere's by less than 1/1700 of the radius."""
_PARTS = ("translation", "rotation", "scale", mesh_layout.POSITIONS)


def moving_targets(keys: Iterable[str]) -> frozenset[str]:
    """Return the ids of the shapes or sensors that parameters of these names would move, rigidly or by vertices."""
    targets = set()
    for key in keys:
        owner, _, name = key.rpartition(".")
        if name in ("x", "y", "z"):
            owner, _, name = owner.rpartition(".")
        if name in _PARTS:
            targets.add(owner)
    return frozenset(targets)


def meshed(scene: Any, ids: AbstractSet[str]) -> tuple[Any, list[str]]:
    """Return the scene with these spheres replaced by meshes, and their ids.

    Spheres are not replaced if they are emitters, sensors or boundaries of media, or if they are mirrors or glass, whose facets would be
    visible. No sphere is replaced in a scene with a sensor that is a shape, nor on a GPU in one with shape groups. The mesh has the
    sphere's texture coordinates and vertex normals, which are interpolated linearly.
    """
    spheres = [shape for shape in scene.shapes() if shape.class_name() == "Sphere" and shape.id() in ids]
    spheres = [
        shape
        for shape in spheres
        if not (shape.is_emitter() or shape.is_sensor() or shape.is_medium_transition())
        and not mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta)
    ]
    if not spheres or any(sensor.get_shape() is not None for sensor in scene.sensors()):
        return scene, []
    groups = [group for group in ObjectGraph(scene).of("shape") if group.class_name().startswith("ShapeGroup")]
    if groups and variant.is_gpu():  # OptiX cannot have a group in two scenes, and ends the process
        return scene, []
    replaced = [shape.id() for shape in spheres]
    objects = [_mesh(shape) if shape.id() in replaced else shape for shape in scene.shapes()]
    # The shape groups of instances are not among the scene's shapes.
    objects += groups
    objects += [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
    own = [] if scene.integrator() is None else [scene.integrator()]
    return scene_of([*objects, *scene.sensors(), *own]), replaced


def _mesh(sphere: Any) -> Any:
    """Return a mesh of latitude rows, with duplicate vertices at the seam."""
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, _COLUMNS + 1), np.linspace(0, 1, _ROWS + 1)))
    turn, tilt = 2 * np.pi * (u % 1), np.pi * v
    normals = np.stack([np.cos(turn) * np.sin(tilt), np.sin(turn) * np.sin(tilt), np.cos(tilt)], -1)
    normals[v == 0], normals[v == 1] = (0, 0, 1), (0, 0, -1)
    corner = (np.arange(_ROWS)[:, None] * (_COLUMNS + 1) + np.arange(_COLUMNS)).ravel()
    down, right = corner + _COLUMNS + 1, corner + 1
    faces = np.concatenate([np.stack([corner, down, right], -1), np.stack([right, down, down + 1], -1)])
    matrix = np.array(mi.traverse(sphere)["to_world"].matrix, float).reshape(4, 4)  # pyright: ignore[reportAttributeAccessIssue]
    points = normals @ matrix[:3, :3].T + matrix[:3, 3]
    normals = normals @ matrix[:3, :3].T
    sample = sphere.sample_position(0.0, mi.Point2f(0.3, 0.4))
    outwards = np.array(sample.p).reshape(-1) - matrix[:3, 3]
    if outwards @ np.array(sample.n).reshape(-1) < 0:  # `flip_normals`
        normals, faces = -normals, faces[:, ::-1]
    mesh = mesh_layout.build(sphere.id(), points, faces, unit(normals), np.stack([u, v], -1), sphere.bsdf())
    mesh.set_id(sphere.id())
    return mesh


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (N, 3) of length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
