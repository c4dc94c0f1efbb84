"""Captures on a turntable: the camera and the light stand still while the object turns, and poses are in the object's world.

The light then turns in that world, by the same angle about the table's axis as the camera. Whether a capture is one shows in the
background: it stands still in the photographs although the poses differ.
"""

from __future__ import annotations

import numpy as np

from unrender.app.capture.capture import CapturedViews

_LIKENESS = 0.4
_BLUR = 1 / 32
"""Of the picture's longer side: tripods and crops move a little."""
_FEWEST_PIXELS = 200
_FEWEST_VIEWS = 4
_CONTRAST = 0.01
"""Standard deviation of the background, as displayed, below which it tells nothing."""
_ANGLE = np.radians(20)
_LEVEL = 0.98
"""Mean of the axis as the cameras see it, at least: their height above the table hardly changes."""


def axis(poses: np.ndarray) -> np.ndarray:
    """The table's axis, upwards, (3,) unit: the direction in the world that differs least as the cameras see it.

    Args:
        poses: (N, 4, 4) camera to world, axes right, up, backwards.
    """
    mean = np.mean(poses[:, :3, :3].transpose(0, 2, 1), 0)
    found = np.linalg.svd(mean)[2][0]
    return found if (mean @ found)[1] >= 0 else -found


def light_turns(poses: np.ndarray) -> np.ndarray:
    """Rotations (N, 3, 3), from the axes of the light's map to the world's, for light that stands still before each camera.

    The map's y is the table's axis, its z points towards the camera as seen from above.
    """
    up = axis(poses)
    found = []
    for pose in poses[:, :3, :3]:
        # The camera's backward axis, or, where it looks down along the table's axis, what is below in its picture.
        towards = max((pose[:, 2], -pose[:, 1]), key=lambda v: float(np.linalg.norm(v - up * (v @ up))))
        z = towards - up * (towards @ up)
        z /= np.linalg.norm(z)
        found.append(np.stack([np.cross(up, z), up, z], 1))
    return np.array(found)


def stands_still(views: CapturedViews) -> bool:
    """Whether the background is the same in photographs whose poses differ by more than 20 degrees, all from one height."""
    poses = np.array([view.camera_to_world for view in views])
    seen = poses[:, :3, :3].transpose(0, 2, 1) @ axis(poses)
    return float(np.linalg.norm(seen.mean(0))) > _LEVEL and likeness(views) > _LIKENESS


def likeness(views: CapturedViews) -> float:
    """The mean correlation of two photographs' backgrounds, over pairs whose poses differ by more than 20 degrees; 0 where it is unknown.

    Of the background's variation along each row alone: what is above and what is below are alike wherever one stands.
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
    found, poses = [], []
    for view in views:
        blurred = ndimage.gaussian_filter(srgb(np.clip(view.values, 0, 1)), (_BLUR * longer, _BLUR * longer, 0))
        inside = np.where(empty[..., None], blurred, 0)
        values = (inside - inside.sum(1, keepdims=True) / rows)[empty].ravel()
        if (spread := float(values.std())) > _CONTRAST:
            found.append((values / spread).astype(np.float32))
            poses.append(view.camera_to_world[:3, :3])
    if len(found) < _FEWEST_VIEWS:
        return 0.0
    correlations = np.array(found) @ np.array(found).T / len(found[0])
    apart = np.einsum("aij,bij->ab", poses, poses) < 1 + 2 * np.cos(_ANGLE)
    return float(correlations[apart].mean()) if apart.any() else 0.0
