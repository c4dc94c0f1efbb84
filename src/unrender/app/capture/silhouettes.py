"""Silhouettes of a mesh in photographs, and their overlap with the masks."""

from __future__ import annotations

from typing import Any

import numpy as np

from unrender.app.capture.cameras import Lens
from unrender.app.capture.capture import CapturedViews
from unrender.app.capture.mesh import Mesh


class Silhouettes:
    """Intersections of rays through pixel centres with a mesh.

    Args:
        mesh: it is centred and scaled to a unit box internally, so that single precision suffices at any position.
    """

    def __init__(self, mesh: Mesh):
        import mitsuba as mi

        from unrender.app.capture.mesh import normals
        from unrender.rendering.mitsuba import mesh_layout

        self._middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
        self._extent = float(np.ptp(mesh.vertices, axis=0).max())
        local = Mesh((mesh.vertices - self._middle) / self._extent, mesh.faces, mesh.uv, mesh.normals)
        own = normals(local) if local.normals is None else local.normals
        made = mesh_layout.build("mesh", local.vertices, local.faces, own)
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
