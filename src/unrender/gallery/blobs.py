"""Closed meshes around implicit surfaces: blended bodies of rounded parts, and intersections of extruded outlines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Ellipsoid:
    """A part of a body.

    Attributes:
        centre: (3,).
        radii: along x, y and z before the tilt, (3,).
        tilt: rotation about z in degrees.
    """

    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    tilt: float = 0.0

    @property
    def axes(self) -> np.ndarray:
        """Half-axes as columns, (3, 3)."""
        c, s = np.cos(np.radians(self.tilt)), np.sin(np.radians(self.tilt))
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) * np.array(self.radii)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Return the depth of points (N, 3), (N,): positive inside, approximately the distance near the surface."""
        local = (points - np.array(self.centre)) @ np.linalg.inv(self.axes).T
        length = np.linalg.norm(local, axis=1)
        slope = np.linalg.norm(local @ np.linalg.inv(self.axes), axis=1) / np.maximum(length, 1e-9)
        return (1.0 - length) / np.maximum(slope, 1e-9)


def united(parts: Sequence[Ellipsoid], blend: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return the depth function of the union of parts, rounded over `blend` where they meet."""

    def depth(points: np.ndarray) -> np.ndarray:
        return blend * np.logaddexp.reduce([part.depth(points) / blend for part in parts])

    return depth


def around(
    depth: Callable[[np.ndarray], np.ndarray], low: Sequence[float], high: Sequence[float], spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh where a depth is 0, by marching cubes: positions (V, 3) and faces (F, 3), facing outward.

    Args:
        depth: function of points (N, 3) that returns (N,), positive inside; negative on the sides of the box.
        low, high: corners of the box.
        spacing: spacing of the grid.
    """
    from skimage import measure

    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    values = np.clip(depth(grid.reshape(-1, 3)), -3 * spacing, 3 * spacing).reshape(grid.shape[:3])
    points, faces, _, _ = measure.marching_cubes(values, 0.0, gradient_direction="ascent")
    return points * spacing + np.asarray(low, float), faces.astype(np.int64)
