"""The content of a scene that other programs can import: meshes with their materials, the environment map, the cameras.

Texture coordinates are those of Mitsuba: (0, 0) is the upper left corner of a picture and v points downwards, as in glTF. The world
space is that of Mitsuba, right-handed, without a rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import mitsuba as mi
import numpy as np

from unrender.app.exporting.materials import Material, check_size, read_material
from unrender.core.errors import InputError
from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.description import load

_CONSTANT_SIZE = (16, 32)


@dataclass(frozen=True)
class Part:
    """A mesh and its material.

    Attributes:
        name: unique name of the shape.
        vertices: (V, 3) float32, in world space.
        faces: (F, 3) uint32, counter-clockwise seen from the side of the normals.
        normals: (V, 3) float32 unit vectors; None for flat shading.
        uv: (V, 2) float32; None without texture coordinates.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    material: Material


@dataclass(frozen=True)
class Camera:
    """A perspective camera.

    Attributes:
        name: id of the sensor.
        to_world: (4, 4), axes left, up, forwards, which are Mitsuba's.
        x_fov: horizontal angle of view in degrees.
        offset: `principal_point_offset_x` and `_y`: 0.5 - cx / width, 0.5 - cy / height.
        size: width and height in pixels.
        clip: distances of the near and far clipping planes.
    """

    name: str
    to_world: np.ndarray
    x_fov: float
    offset: tuple[float, float]
    size: tuple[int, int]
    clip: tuple[float, float]


@dataclass(frozen=True)
class Asset:
    """The exportable content of a scene.

    Attributes:
        parts: the meshes, at least one.
        environment: (H, W, 3) float32 radiance, in the layout of the file of a `mitsuba.Emitter` envmap; None without an environment map.
        environment_to_world: (3, 3) rotation from the axes of the map to those of the world.
        cameras: the cameras of the scene, in its order.
        notices: one line for each part of the scene that is not exported.
    """

    parts: tuple[Part, ...]
    environment: np.ndarray | None
    environment_to_world: np.ndarray
    cameras: tuple[Camera, ...]
    notices: tuple[str, ...]


def read(path: Path) -> Asset:
    """Return the asset of a scene file.

    Raises `InputError` if the scene has no mesh, a material has maps but its mesh no texture coordinates, or a map is too large.
    """
    scene: Any = load(path)
    notices: list[str] = []
    parts = [part for shape in scene.shapes() if (part := _part(shape, notices)) is not None]
    if not parts:
        raise InputError("asset: the scene has no mesh that could be exported" + "".join(f"; {n}" for n in notices[:3]))
    environment, turned = read_environment(scene, notices)
    cameras = [camera for sensor in scene.sensors() if (camera := _camera(sensor, notices)) is not None]
    return Asset(_with_different_names(parts), environment, turned, tuple(cameras), tuple(notices))


def _part(shape: Any, notices: list[str]) -> Part | None:
    name = shape.id()
    if not isinstance(shape, mi.Mesh):
        notices.append(f"{name}: a {shape.class_name()} is not a mesh and is left out")
        return None
    if shape.is_emitter():
        notices.append(f"{name}: its light is not carried over")
    vertices, faces, normals, uv = _geometry(shape)
    if not len(faces) or not np.isfinite(vertices).all():
        raise InputError(f"asset: {name} has no faces, or vertices that are not finite")
    material, notes = read_material(shape.bsdf())
    notices += [f"{name}: {note}" for note in notes]
    if material.textured and uv is None:
        raise InputError(f"asset: {name} has maps but no texture coordinates; unwrap its mesh first")
    if uv is not None and material.to_uv is not None:
        uv = (uv @ material.to_uv[:2, :2].T + material.to_uv[:2, 2]).astype(np.float32)
    faces, normals = _turned_to_front(shape, vertices, faces, normals)
    return Part(name, vertices, faces, normals, uv, replace(material, to_uv=None))


def _turned_to_front(
    shape: Any, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return faces and normals on the side of Mitsuba's shading normals, which a mirrored to_world and flip_normals may turn over."""
    corners = vertices[faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ray, hit = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1)), cast(Any, mi.PreliminaryIntersection3f())
    hit.prim_index, hit.prim_uv = mi.UInt32(np.arange(len(faces), dtype=np.uint32)), mi.Point2f(1 / 3, 1 / 3)
    front = np.array(shape.compute_surface_interaction(ray, hit, mi.RayFlags.All).sh_frame.n).T
    if np.sum(across * front) < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    return faces, -normals if normals is not None and np.sum(normals[faces].sum(1) * front) < 0 else normals


def _geometry(shape: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
    parameters: Any = mesh_layout.traverse(shape)
    if mesh_layout.POSITIONS not in parameters:  # a rectangle, whose mesh is made when it is rendered
        corners = np.array([[-1.0, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1]])
        vertices = corners @ np.array(parameters["to_world"].matrix, float).reshape(4, 4).T
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        return vertices[:, :3].astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.uint32), None, uv
    vertices = np.array(mesh_layout.vertex_positions(shape), np.float32).reshape(-1, 3)
    faces = np.array(parameters[mesh_layout.FACES], np.uint32).reshape(-1, 3)
    normals = (
        np.array(parameters[mesh_layout.NORMALS], np.float32).reshape(-1, 3) if mesh_layout.has_normals(shape) else None
    )
    if normals is not None:
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    uv = (
        np.array(parameters[mesh_layout.TEXCOORDS], np.float32).reshape(-1, 2)
        if mesh_layout.has_texcoords(shape)
        else None
    )
    return vertices, faces, None if shape.has_face_normals() else normals, uv


def read_environment(scene: Any, notices: list[str]) -> tuple[np.ndarray | None, np.ndarray]:
    """Return the environment map of a live scene and its rotation, as in `Asset`. Append a line to `notices` for each other light.

    Raises `InputError` if the map is too large.
    """
    environment, to_world = None, np.eye(3)
    for emitter in scene.emitters():
        values: Any = mi.traverse(emitter)
        if emitter.class_name() == "EnvironmentMapEmitter":
            pixels = np.array(values["data"])[:, 1:-1, :3]  # without the columns that Mitsuba repeats
            check_size("environment map", pixels)
            environment = np.ascontiguousarray(pixels * float(np.array(values["scale"]).ravel()[0]), np.float32)
            to_world = np.array(values["to_world"].matrix, float).reshape(4, 4)[:3, :3]
        elif emitter.class_name() == "ConstantBackgroundEmitter" and "radiance.value" in values:
            radiance = np.broadcast_to(np.array(values["radiance.value"], np.float32).ravel(), (3,))
            environment = np.broadcast_to(radiance, (*_CONSTANT_SIZE, 3)).copy()
        elif emitter.class_name() != "AreaLight":  # exported with its shape
            notices.append(f"{emitter.id() or 'light'}: a {emitter.class_name()} is not carried over")
    return environment, to_world


def _camera(sensor: Any, notices: list[str]) -> Camera | None:
    values: Any = mi.traverse(sensor)
    if "x_fov" not in values:
        notices.append(f"{sensor.id()}: a {sensor.class_name()} is not carried over")
        return None
    if sensor.class_name() != "PerspectiveCamera":
        notices.append(f"{sensor.id()}: a {sensor.class_name()} becomes a pinhole camera")
    number = {name: float(np.array(values[name]).ravel()[0]) for name in _NUMBERS if name in values}
    width, height = (int(x) for x in np.array(values["film.size"]))
    return Camera(
        sensor.id(),
        np.array(values["to_world"].matrix, float).reshape(4, 4),
        number["x_fov"],
        (number.get("principal_point_offset_x", 0.0), number.get("principal_point_offset_y", 0.0)),
        (width, height),
        (number.get("near_clip", 0.01), number.get("far_clip", 1e4)),
    )


_NUMBERS = ("x_fov", "principal_point_offset_x", "principal_point_offset_y", "near_clip", "far_clip")


def _with_different_names(parts: Sequence[Part]) -> tuple[Part, ...]:
    from unrender.app.exporting.ready_made import file_name

    taken: set[str] = set()
    renamed = []
    for index, part in enumerate(parts):
        name = file_name(part.name)
        name = f"{name}-{index}" if name in taken or not part.name else name
        taken.add(name)
        renamed.append(replace(part, name=name))
    return tuple(renamed)
