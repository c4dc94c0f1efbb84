"""Shared parts of problems with unknown poses: a sun, and unknown coordinates.

Their lights come from one direction each. Direct light has no noise, so renders of a pose are noisy at edges only.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from unrender.gallery import parts
from unrender.scene.parameter import Parameter


def sun(towards: parts.Vector, *rgb: float) -> dict[str, Any]:
    """Return light from one direction.

    Args:
        towards: direction towards the light, of any length.
        rgb: radiance of a white surface that faces it; one number is grey.
    """
    direction = -np.asarray(towards, float)
    irradiance = [np.pi * value for value in rgb]
    return {"type": "directional", "direction": direction.tolist(), "irradiance": parts.colour(*irradiance)}


def unknown(
    shape: str, part: str, start: dict[str, float], bounds: tuple[float, float] | None = None
) -> list[Parameter]:
    """Return coordinates of the pose of a shape or light, which are 0 in the true scene.

    Args:
        shape: id of the shape or light.
        part: "translation" or "rotation".
        start: {"x" | "y" | "z": initial value}; other coordinates are known.
        bounds: bounds of each coordinate.
    """
    return [Parameter(f"{shape}.{part}.{axis}", initial=value, bounds=bounds) for axis, value in start.items()]
