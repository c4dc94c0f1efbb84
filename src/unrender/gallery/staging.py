"""What the problems of unknown poses share: a sun, unknown coordinates.

Their lights come from one direction each: direct light without noise, so that what a render shows of a pose is noisy at edges alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from unrender.gallery import parts
from unrender.scene.parameter import Parameter

__all__ = ["sun", "unknown"]


def sun(towards: parts.Vector, *rgb: float) -> dict[str, Any]:
    """Light from one direction.

    Args:
        towards: where it comes from; any length.
        rgb: radiance of a white surface that faces it; one number is grey.
    """
    direction = -np.asarray(towards, float)
    irradiance = [np.pi * value for value in rgb]
    return {"type": "directional", "direction": direction.tolist(), "irradiance": parts.colour(*irradiance)}


def unknown(
    shape: str, part: str, start: dict[str, float], bounds: tuple[float, float] | None = None
) -> list[Parameter]:
    """Coordinates of the pose of a shape or light, which are 0 in the true scene.

    Args:
        shape: the id of the shape or light.
        part: "translation" or "rotation".
        start: {"x" | "y" | "z": where the descent starts}; what is not named stays as it is.
        bounds: of each.
    """
    return [Parameter(f"{shape}.{part}.{axis}", initial=value, bounds=bounds) for axis, value in start.items()]
