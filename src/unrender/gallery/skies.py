"""Skies with a sun, as latitude-longitude pictures for Mitsuba's `envmap`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.gallery import parts

__all__ = ["CLEAR", "environment", "picture"]

CLEAR = ((0.12, 0.25, 0.6), (0.65, 0.7, 0.75), (0.2, 0.18, 0.15))
"""Of zenith, horizon, and what is below it: noon over bare ground."""


def picture(
    sun: parts.Vector, radius: float, radiance: parts.Vector, colours: Sequence[parts.Vector] = CLEAR, rows: int = 128
) -> np.ndarray:
    """A sky with a sun: (rows, 2 rows, 3) float32 radiance, the zenith in its first row.

    Args:
        sun: direction to the sun, of length 1.
        radius: of the sun, an angle in radians; a texel belongs to it where its middle does.
        radiance: RGB of the sun.
        colours: RGB radiance of zenith, horizon, and what is below it.
        rows: of the picture.
    """
    columns = 2 * rows
    theta = np.pi * (np.arange(rows)[:, None] + 0.5) / rows
    phi = 2 * np.pi * (np.arange(columns)[None, :] + 0.5) / columns
    # Mitsuba's convention: u = atan2(x, -z) / 2 pi, v = acos(y) / pi.
    direction = np.stack(
        np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)), -1
    )
    height = direction[..., 1:2]
    zenith, horizon, below = (np.asarray(colour, float) for colour in colours)
    sky = horizon + (zenith - horizon) * np.clip(height, 0, 1) ** 0.5
    sky = np.where(height < 0, below, sky)
    within = np.arccos(np.clip(direction @ np.asarray(sun, float), -1, 1)) < radius
    return np.where(within[..., None], np.asarray(radiance, float), sky).astype(np.float32)


def environment(values: np.ndarray) -> dict[str, Any]:
    """The light of a picture, the y axis upwards, as a Mitsuba dictionary."""
    return {"type": "envmap", "bitmap": mi.Bitmap(values), "to_world": mi.ScalarTransform4f()}
