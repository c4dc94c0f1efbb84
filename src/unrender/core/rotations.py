"""Rotation matrices, and conversion of camera axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

MITSUBA_TO_OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Right factor that converts a camera-to-world matrix (4, 4) from one convention to the other. It is its own inverse."""
MITSUBA_TO_OPENGL.setflags(write=False)


def rotation(axis: Sequence[float] | np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) of column vectors, counterclockwise by radians seen from the tip of a unit axis (Rodrigues'
    formula)."""
    x, y, z = np.asarray(axis, float)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    cosine, sine = np.cos(angle), np.sin(angle)
    return cosine * np.eye(3) + sine * cross + (1 - cosine) * np.outer((x, y, z), (x, y, z))
