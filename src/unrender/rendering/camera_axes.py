"""Conversion of camera axes: Mitsuba uses left, up, forward; OpenGL, Blender and NeRF use right, up, backward."""

from __future__ import annotations

import numpy as np

MITSUBA_TO_OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Right factor that converts a camera-to-world matrix (4, 4) from one convention to the other. It is its own inverse."""
MITSUBA_TO_OPENGL.setflags(write=False)
