"""Rotation matrices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def rotation(axis: Sequence[float] | np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) of column vectors, counterclockwise seen from the axis's tip (Rodrigues' formula).

    Args:
        axis: (3,) unit.
        angle: radians.
    """
    x, y, z = np.asarray(axis, float)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    cosine, sine = np.cos(angle), np.sin(angle)
    return cosine * np.eye(3) + sine * cross + (1 - cosine) * np.outer((x, y, z), (x, y, z))
