"""Conventions of camera poses: camera axes of each format, and conversion of matrices to poses.

| name | x | y | z | written by |
|---|---|---|---|---|
| opengl | right | up | backwards | NeRF, instant-ngp, nerfstudio, Blender |
| opencv | right | down | forwards | COLMAP, OpenCV |
| llff | down | right | backwards | LLFF's `poses_bounds.npy` |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from unrender.app.capture.cameras import rigid
from unrender.app.capture.capture import Capture
from unrender.core.errors import InputError

AXES = {
    "opengl": np.eye(3),
    "opencv": np.diag([1.0, -1.0, -1.0]),
    "llff": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Columns x, y and z of each convention, in the axes right, up, backwards."""


def pose(matrix: object, axes: str, world_to_camera: bool, where: str) -> tuple[np.ndarray, float]:
    """Return the matrix of a file as camera-to-world, (4, 4), with the axes right, up, backwards, and the removed scale of its axes.

    For a world-to-camera matrix [sR | t], the camera is at -Rᵀ t / s. Raises `InputError`.
    """
    camera, scale = rigid(matrix, where)
    if world_to_camera:
        with np.errstate(over="ignore"):
            camera[:3, 3] /= scale
        if not np.isfinite(camera).all():
            raise InputError(f"{where}: its axes are too short for its position")
        camera = _inverse(camera)
    camera[:3, :3] = camera[:3, :3] @ AXES[axes].T
    return camera, scale


def reinterpreted(capture: Capture, axes: str, world_to_camera: bool) -> Capture:
    """Return the capture for another convention of its files. Raise `InputError` for an unknown name of axes."""
    if axes not in AXES:
        raise InputError(f"axes: expected one of {', '.join(AXES)}, got {axes!r}")
    photographs = []
    for photograph in capture.photographs:
        stored = photograph.camera_to_world.copy()
        stored[:3, :3] = stored[:3, :3] @ AXES[capture.axes]
        if capture.world_to_camera:
            stored = _inverse(stored)
            stored[:3, 3] *= photograph.scale
        stored[:3, :3] *= photograph.scale
        moved, _ = pose(stored, axes, world_to_camera, photograph.name)
        photographs.append(replace(photograph, camera_to_world=moved))
    return replace(capture, photographs=tuple(photographs), axes=axes, world_to_camera=world_to_camera)


def _inverse(matrix: np.ndarray) -> np.ndarray:
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse
