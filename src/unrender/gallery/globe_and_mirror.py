"""`globe-and-mirror`: the texture of a globe in a glass ball, whose back is seen in a mirror, from one picture.

The earth under glass of the adaptive sampling of pixels (its Fig. 9), one large picture. Light reaches the globe through two refractions,
and what the mirror shows of it through as many and a reflection.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, textures, two_planets
from unrender.losses import L2, Loss
from unrender.preconditioners import LargeSteps
from unrender.scene.parameter import Parameter

_GLOBE, _INNER, _OUTER = 0.72, 0.92, 1.0
"""Radii of the globe and of the two sides of the glass."""
_EYE, _MIRROR = np.array([1.4, 0.8, 6.0]), np.array([-2.1, 0.1, -1.5])
"""Where the camera and the middle of the mirror are."""


@register(name="globe-and-mirror", position=32)
@dataclass(frozen=True)
class GlobeAndMirror:
    """The texture of a globe within glass, whose back shows in a mirror, from one picture.

    One view; an unknown reflectance of texture_resolution² texels, from grey, with LargeSteps. A part of the back is seen in neither way.
    Paths from the mirror to the globe and on to the light have 7 segments.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    reference_spp: int = fields.reference_spp(512)
    max_depth: int = fields.max_depth(9, at_least=7)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """The globe around the origin, the mirror behind it at its left, turned so that the camera sees the globe in its middle."""
        normal = _unit(_unit(_EYE - _MIRROR) + _unit(-_MIRROR))
        right = _unit(np.cross([0.0, 1.0, 0.0], normal))
        up = np.cross(normal, right)
        globe = meshes.ellipsoid(_GLOBE * np.eye(3), np.zeros(3), 48, 96)
        paint = {"type": "diffuse", "reflectance": textures.bitmap(two_planets.blue(self.texture_resolution))}
        return {
            "type": "scene",
            "camera": parts.camera(_EYE, (-0.7, 0.0, -0.2), 34.0, self.resolution),
            "sky": two_planets.sky(),
            "globe": meshes.sheet("globe", globe, paint, closed=True),
            "glass": two_planets.shell(_OUTER, 1.5, 1.0),
            "hollow": two_planets.shell(_INNER, 1.0, 1.5),
            "mirror": parts.rectangle(_MIRROR, 1.1 * right, 1.3 * up, {"type": "conductor", "material": "Ag"}),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """The texture, grey at first."""
        return (Parameter("globe.bsdf.reflectance.data", initial=0.5, preconditioner=LargeSteps(1.0)),)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
