"""Conversion of moving spheres to meshes: boundary derivatives are sampled on edges, which a sphere does not have."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Set as AbstractSet
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba import gpu, mesh_layout
from unrender.rendering.mitsuba.scene_graph import ObjectGraph

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

    Spheres are not replaced if they are emitters, sensors or boundaries of media, or if they are mirrors or glass, whose facets would
    be visible. No sphere is replaced in a scene with a sensor that is a shape, nor on a GPU in one with shape groups.

    The mesh has the sphere's texture coordinates and vertex normals, which are interpolated linearly.

    Args:
        scene: `mi.Scene`.
        ids: ids of shapes, including spheres.
    """
    spheres = [shape for shape in scene.shapes() if shape.class_name() == "Sphere" and shape.id() in ids]
    spheres = [
        shape
        for shape in spheres
        if not (shape.is_emitter() or shape.is_sensor() or shape.is_medium_transition() or _is_specular(shape.bsdf()))
    ]
    if not spheres or any(sensor.get_shape() is not None for sensor in scene.sensors()):
        return scene, []
    groups = [group for group in ObjectGraph(scene).of("shape") if group.class_name().startswith("ShapeGroup")]
    if groups and gpu.is_gpu():  # OptiX cannot have a group in two scenes, and ends the process
        return scene, []
    replaced = [shape.id() for shape in spheres]
    objects = [_mesh(shape) if shape.id() in replaced else shape for shape in scene.shapes()]
    # The shape groups of instances are not among the scene's shapes.
    objects += groups
    objects += [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
    described: dict[str, Any] = {"type": "scene"}
    own = [] if scene.integrator() is None else [scene.integrator()]
    for index, item in enumerate([*objects, *scene.sensors(), *own]):
        name = item.id()
        described[name if name and name not in described else f"object_{index}"] = item
    return mi.load_dict(described, parallel=False, optimize=False), replaced


def _is_specular(bsdf: Any) -> bool:
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)


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
    mesh = mesh_layout.build(sphere.id(), points, faces, _unit(normals), np.stack([u, v], -1), sphere.bsdf())
    mesh.set_id(sphere.id())
    return mesh


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
