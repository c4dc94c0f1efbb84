"""Silhouettes of a mesh in photographs, their overlap with the masks, overlays of both over each photograph, and turntable captures.

On a turntable, camera and light are fixed while the object rotates, and poses are in the object's frame. There the light rotates about
the table's axis by the same angle as the camera. The background identifies such a capture: it is the same although the poses differ.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from unrender.app.capture.cameras import Lens
from unrender.app.capture.capture import CapturedView, CapturedViews
from unrender.app.capture.mesh import Mesh, shading_normals
from unrender.losses.metrics import srgb


class Silhouettes:
    """Intersections of rays through pixel centres with a mesh, centred and scaled to a unit box, so that single precision suffices at any
    position."""

    def __init__(self, mesh: Mesh):
        import mitsuba as mi

        from unrender.rendering.mitsuba import mesh_layout

        self._middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
        self._extent = float(np.ptp(mesh.vertices, axis=0).max())
        local = Mesh((mesh.vertices - self._middle) / self._extent, mesh.faces, mesh.uv, mesh.normals)
        made = mesh_layout.build("mesh", local.vertices, local.faces, shading_normals(local))
        self._scene: Any = mi.load_dict({"type": "scene", "mesh": made})

    def mask(self, lens: Lens, camera_to_world: np.ndarray) -> np.ndarray:
        """Return (H, W), whether the ray through a pixel's centre hits the mesh."""
        return np.array(self._scene.ray_test(self._rays(lens, camera_to_world))).reshape(lens.height, lens.width)

    def normals(self, lens: Lens, camera_to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return normals in the camera's axes, (H, W, 3), 0 without a hit, and distances in units of the mesh's extent, (H, W)."""
        import drjit as dr
        import mitsuba as mi

        hits = self._scene.ray_intersect(self._rays(lens, camera_to_world))
        valid = hits.is_valid()
        normal = np.array(dr.select(valid, hits.sh_frame.n, mi.Normal3f(0))).T @ camera_to_world[:3, :3]
        distance = np.array(dr.select(valid, hits.t, 0))
        return normal.reshape(lens.height, lens.width, 3), distance.reshape(lens.height, lens.width)

    def _rays(self, lens: Lens, camera_to_world: np.ndarray) -> Any:
        import mitsuba as mi

        x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
        local = np.stack([(x - lens.cx) / lens.fx, -(y - lens.cy) / lens.fy, -np.ones_like(x)], -1).reshape(-1, 3)
        directions = local @ camera_to_world[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origin = (camera_to_world[:3, 3] - self._middle) / self._extent
        origins = np.broadcast_to(origin, directions.shape)
        return mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32)))


def overlap(silhouettes: Silhouettes, views: CapturedViews) -> list[float]:
    """Return the intersection over union of the mesh's silhouette and the mask, for each view with a mask, inside the photograph."""
    ratios = []
    for view in views:
        if view.mask is not None:
            known = view.shown > 0.5
            mask, silhouette = (view.mask > 0.5) & known, silhouettes.mask(view.lens, view.camera_to_world) & known
            ratios.append(float((mask & silhouette).sum() / max(1, (mask | silhouette).sum())))
    return ratios


LEGEND = "orange: the mesh and its edges; blue: the outline of the mask; dimmed: outside the mesh"
_MESH, _MASK = np.array([1.0, 0.55, 0.05]), np.array([0.1, 0.55, 1.0])
_SMALLEST = 320  # minimum number of pixels along the shorter side of an overlay
_TINT = 0.3
_CREASE = math.cos(math.radians(50))
_LARGEST_SHEET = 48


def overlay(view: CapturedView, silhouettes: Silhouettes) -> np.ndarray:
    """Return an overlay (h, w, 3) in [0, 1], sRGB, enlarged by an integer factor for small views."""
    factor = max(1, math.ceil(_SMALLEST / max(1, min(view.lens.width, view.lens.height))))
    lens = view.lens.scaled(factor * view.lens.width, factor * view.lens.height)
    normals, distances = silhouettes.normals(lens, view.camera_to_world)
    inside = np.any(normals != 0, -1)
    photograph = _enlarged(srgb(view.values * _exposure(view)), factor)
    shading = 0.35 + 0.65 * np.clip(np.abs(normals[..., 2:]), 0, 1)
    tinted = (1 - _TINT) * photograph + _TINT * shading * _MESH
    picture = np.where(inside[..., None], tinted, 0.6 * photograph)
    picture[_creases(normals, distances, inside)] *= 0.55
    picture[_outline(inside)] = _MESH
    if view.mask is not None:
        picture[_outline(_enlarged(view.mask, factor) > 0.5)] = _MASK
    return np.clip(picture, 0, 1)


def chosen(count: int) -> list[int]:
    """Return the indices of at most 48 evenly spaced pictures for a contact sheet."""
    return np.unique(np.linspace(0, count - 1, min(count, _LARGEST_SHEET)).round().astype(int)).tolist()


def _exposure(view: CapturedView) -> float:
    level = float(np.percentile(view.values if view.mask is None else view.values[view.mask > 0.5], 97))
    return min(0.8 / level, 16.0) if level > 0 else 1.0


def _enlarged(picture: np.ndarray, factor: int) -> np.ndarray:
    return np.repeat(np.repeat(picture, factor, 0), factor, 1)


def _outline(inside: np.ndarray) -> np.ndarray:
    padded = np.pad(inside, 1, mode="edge")
    surrounded = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return inside & ~surrounded


def _creases(normals: np.ndarray, distances: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the pixels where, from one pixel to the next, normals change by more than 50° or depth is discontinuous."""
    edges = np.zeros(inside.shape, bool)
    for axis in (0, 1):
        here, there = [slice(None)] * 2, [slice(None)] * 2
        here[axis], there[axis] = slice(0, -1), slice(1, None)
        a, b = tuple(here), tuple(there)
        both = inside[a] & inside[b]
        edges[a] |= both & ((normals[a] * normals[b]).sum(-1) < _CREASE)
        edges[a] |= both & (np.abs(distances[a] - distances[b]) > 0.06)
    return edges


_LIKENESS = 0.4
_BLUR = 1 / 32  # blur relative to the picture's longer side, which tolerates small movements of tripod and crop
_FEWEST_PIXELS = 200
_FEWEST_VIEWS = 4
_CONTRAST = 0.01  # minimum standard deviation of an informative background, in display values
_ANGLE = np.radians(20)
_LEVEL = 0.98  # minimum length of the mean axis in camera coordinates: the cameras' elevation is nearly constant


def axis(poses: np.ndarray) -> np.ndarray:
    """Return the table's axis upwards, (3,) unit: the world direction that varies least in camera coordinates of poses (N, 4, 4)."""
    mean = np.mean(poses[:, :3, :3].transpose(0, 2, 1), 0)
    direction = np.linalg.svd(mean)[2][0]
    return direction if (mean @ direction)[1] >= 0 else -direction


def light_turns(poses: np.ndarray) -> np.ndarray:
    """Return rotations (N, 3, 3) from the axes of the light's map to the world's, for a light that is fixed relative to each camera.

    The map's y axis is the table's axis; its z axis points towards the camera as seen from above.
    """
    up = axis(poses)
    rotations = []
    for pose in poses[:, :3, :3]:
        # Use the camera's backward axis or, if it looks down along the table's axis, the downward direction of its picture.
        towards = max((pose[:, 2], -pose[:, 1]), key=lambda v: float(np.linalg.norm(v - up * (v @ up))))
        z = towards - up * (towards @ up)
        z /= np.linalg.norm(z)
        rotations.append(np.stack([np.cross(up, z), up, z], 1))
    return np.array(rotations)


def stands_still(views: CapturedViews) -> bool:
    """Return whether the background is equal in photographs whose poses differ by more than 20 degrees, all from one elevation."""
    poses = np.array([view.camera_to_world for view in views])
    axes = poses[:, :3, :3].transpose(0, 2, 1) @ axis(poses)
    return float(np.linalg.norm(axes.mean(0))) > _LEVEL and likeness(views) > _LIKENESS


def likeness(views: CapturedViews) -> float:
    """Return the mean correlation of two photographs' backgrounds, over pairs whose poses differ by more than 20 degrees; 0 if it is
    unknown.

    Only the background's variation along each row counts, since vertical variation is similar from every viewpoint.
    """
    from scipy import ndimage

    if len(views) < _FEWEST_VIEWS or len({view.values.shape for view in views}) > 1:
        return 0.0
    longer = max(views[0].values.shape[:2])
    empty = np.ones(views[0].values.shape[:2], bool)
    for view in views:
        empty &= view.shown > 0.99
        empty &= (view.mask < 0.01) if view.mask is not None else False
    empty = np.asarray(ndimage.binary_erosion(empty, iterations=max(1, round(_BLUR * longer)), border_value=1))
    if empty.sum() < _FEWEST_PIXELS:
        return 0.0
    rows = np.maximum(empty.sum(1), 1)[:, None, None]
    normalised, poses = [], []
    for view in views:
        blurred = ndimage.gaussian_filter(srgb(np.clip(view.values, 0, 1)), (_BLUR * longer, _BLUR * longer, 0))
        inside = np.where(empty[..., None], blurred, 0)
        values = (inside - inside.sum(1, keepdims=True) / rows)[empty].ravel()
        if (spread := float(values.std())) > _CONTRAST:
            normalised.append((values / spread).astype(np.float32))
            poses.append(view.camera_to_world[:3, :3])
    if len(normalised) < _FEWEST_VIEWS:
        return 0.0
    correlations = np.array(normalised) @ np.array(normalised).T / len(normalised[0])
    apart = np.einsum("aij,bij->ab", poses, poses) < 1 + 2 * np.cos(_ANGLE)
    return float(correlations[apart].mean()) if apart.any() else 0.0
