"""The axes of a camera: Mitsuba's are left, up, forwards; those of OpenGL, Blender and NeRF are right, up, backwards."""

from __future__ import annotations

import numpy as np

MITSUBA_TO_OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])
"""After a camera-to-world matrix (4, 4): that of the same camera in the other axes. It is its own inverse."""
MITSUBA_TO_OPENGL.setflags(write=False)
