"""The hull with photographs projected on it: a texture without light, the baseline of photogrammetry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

import unrender as ur
from benchmarks.internals import stock_scene

_NEAR = 1e-3
"""Of the distance to the camera, within which a surface does not hide itself."""


class Projection:
    """Colours of texels, from the training photographs that see them.

    Args:
        folder: of an import.
        problem: its training views.
        size: texels along the atlas's sides.
    """

    def __init__(self, folder: Path, problem: ur.Problem, size: int):
        scene, _ = stock_scene(problem)
        self._scene: Any = scene
        places, normals, covered = _surface(folder, size)
        total, weights = np.zeros((size * size, 3)), np.zeros(size * size)
        for view in problem.views:
            sensor = scene.sensors()[view.sensor]
            weight, at = _seen(scene, sensor, places, normals)
            weight = np.where(covered, weight, 0) * _at(np.asarray(view.mask)[..., None], at)[:, 0]
            total += weight[:, None] * _at(np.asarray(view.reference), at)
            weights += weight
        known = (weights > 1e-6).reshape(size, size)
        texture = (total / np.maximum(weights, 1e-6)[:, None]).reshape(size, size, 3)
        nearest: Any = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        self.texture = texture[tuple(nearest)]

    def picture(self, problem: ur.Problem, view: int, samples: int = 3) -> np.ndarray:
        """(H, W, 3), the mean of samples² rays a pixel; black where they miss."""
        sensor = self._scene.sensors()[problem.views[view].sensor]
        width, height = (int(side) for side in sensor.film().crop_size())
        fine = np.stack(np.meshgrid(np.arange(width * samples), np.arange(height * samples)), -1).reshape(-1, 2) + 0.5
        ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f((fine / samples / (width, height)).T.astype(np.float32)), 0.5)
        si = self._scene.ray_intersect(ray)
        uv = np.array(si.uv).T * self.texture.shape[:2][::-1]
        found = np.where(np.array(si.is_valid())[:, None], _at(self.texture, uv), 0)
        return found.reshape(height, samples, width, samples, 3).mean((1, 3)).astype(np.float32)


def _surface(folder: Path, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position and normal of each texel's middle (size², 3), and whether the atlas covers it."""
    mesh: Any = mi.traverse(mi.load_dict({"type": "ply", "filename": str(folder / "asset.ply")}))
    uv = np.array(mesh["vertex_texcoords"]).reshape(-1, 2)
    faces = np.array(mesh["faces"]).reshape(-1, 3)
    flat: Any = mi.Mesh("atlas", len(uv), len(faces))
    parameters = mi.traverse(flat)
    parameters["vertex_positions"] = np.concatenate([uv, np.zeros((len(uv), 1))], 1).ravel().astype(np.float32)
    parameters["faces"] = faces.ravel().astype(np.uint32)
    parameters.update()
    atlas: Any = mi.load_dict({"type": "scene", "mesh": flat})
    middle = (np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2) + 0.5) / size
    origin = np.concatenate([middle, np.ones((len(middle), 1))], 1).T.astype(np.float32)
    found = atlas.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(0, 0, -1)))
    covered, face = np.array(found.is_valid()), np.array(found.prim_index)
    share = np.where(covered[:, None], np.array(found.prim_uv).T, 0)
    weights = np.stack([1 - share.sum(1), share[:, 0], share[:, 1]], 1)[..., None]
    corners = faces[np.where(covered, face, 0)]
    places, normals = (
        (np.array(mesh[name]).reshape(-1, 3)[corners] * weights).sum(1)
        for name in ("vertex_positions", "vertex_normals")
    )
    return places, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9), covered


def _seen(scene: Any, sensor: Any, places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The squared cosine of points towards a sensor, 0 where it does not see them; and where they are in its picture, in pixels."""
    ds, _ = sensor.sample_direction(_points(places), mi.Point2f(0.5))
    pose = np.array(sensor.world_transform().matrix, float).reshape(4, 4)
    towards = pose[:3, 3] - places
    distance = np.linalg.norm(towards, axis=1)
    cosine = (normals * towards).sum(1) / distance
    origins = places + _NEAR * towards
    ray = mi.Ray3f(
        mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f((towards / distance[:, None]).T.astype(np.float32))
    )
    hidden = np.array(scene.ray_test(ray))
    inside = np.array(ds.pdf) > 0
    return np.where((cosine > 0.1) & ~hidden & inside, np.maximum(cosine, 0) ** 2, 0), np.array(ds.uv).T


def _points(places: np.ndarray) -> Any:
    it: Any = dr.zeros(mi.Interaction3f, len(places))
    it.p = mi.Point3f(places.T.astype(np.float32))
    return it


def _at(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bilinear look-ups (N, C) at positions in pixels, the middle of the first at 0.5."""
    position = (at - 0.5).T[::-1]
    channels = [
        ndimage.map_coordinates(picture[..., c], position, order=1, mode="nearest") for c in range(picture.shape[2])
    ]
    return np.stack(channels, 1)
