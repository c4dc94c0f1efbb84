"""Turntable captures: camera and light are fixed while the object rotates, and poses are in the object's frame.

In that frame the light rotates about the table's axis by the same angle as the camera. The background identifies such a capture: it is
the same in all photographs although the poses differ.
"""

from __future__ import annotations

import numpy as np

from unrender.app.capture.capture import CapturedViews

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

    from unrender.losses.metrics import srgb

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
