"""Shared parts of problems with participating media: grids, cameras around the origin, a cube with invisible faces."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from unrender.gallery import parts


def grid(values: np.ndarray) -> dict[str, Any]:
    """Return a volume over the cube [-1, 1]³, interpolated linearly between voxel centres.

    Args:
        values: (Z, Y, X, C), stored unchanged.
    """
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    volume = mi.VolumeGrid(np.ascontiguousarray(values, dtype=np.float32))
    return {"type": "gridvolume", "grid": volume, "raw": True, "to_world": place}


def cube(medium: dict[str, Any]) -> dict[str, Any]:
    """Return the cube [-1, 1]³ filled with a medium; its faces do not refract."""
    return {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}


def around(views: int, resolution: int, distance: float = 4.2, fov: float = 36.0) -> dict[str, Any]:
    """Return cameras at equal angles around the y axis, alternately lower and higher, that look at the origin.

    Args:
        views: number of cameras.
        resolution: pixels along a side.
        distance: distance from the origin.
        fov: full angle in degrees.
    """
    angles = np.pi / 6 + 2 * np.pi * np.arange(views) / views
    heights = np.where(np.arange(views) % 2 == 0, 0.25, 0.6)
    return {
        f"camera_{number}": parts.camera(
            distance * np.array([np.sin(a) * np.cos(h), np.sin(h), np.cos(a) * np.cos(h)]), (0, 0, 0), fov, resolution
        )
        for number, (a, h) in enumerate(zip(angles, heights, strict=True))
    }


def positions(resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y and z of the voxel centres of `grid`, each (resolution, resolution, resolution)."""
    middle = (np.arange(resolution) + 0.5) / resolution * 2 - 1
    z, y, x = np.meshgrid(middle, middle, middle, indexing="ij")
    return x, y, z


def noise(resolution: int, octaves: int, seed: int) -> np.ndarray:
    """Return smooth noise of several octaves in [0, 1], each with half the amplitude and twice the frequency: (resolution,) * 3.

    Equal at every resolution, except for detail that the resolution cannot represent.
    """
    from scipy.ndimage import map_coordinates

    rng = np.random.default_rng(seed)
    x, y, z = positions(resolution)
    total = np.zeros_like(x)
    for octave in range(octaves):
        cells = 3 * 2**octave
        values = rng.uniform(0, 1, (cells + 1,) * 3)
        place = [(c + 1) / 2 * cells for c in (z, y, x)]
        total += map_coordinates(values, place, order=1) * 0.5**octave
    return total / (2 - 0.5 ** (octaves - 1))
