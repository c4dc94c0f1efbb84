"""Problem `globe-and-mirror`: the texture of a globe in a glass ball, whose back is visible in a mirror, from one image.

The earth under glass of adaptive pixel sampling (Fig. 9 of its paper), with one large image. Light reaches the globe through two
refractions; its mirror image needs a reflection in addition.
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
"""Positions of the camera and of the mirror's centre."""


@register(name="globe-and-mirror", position=32)
@dataclass(frozen=True)
class GlobeAndMirror:
    """The texture of a globe inside of glass, whose back is visible in a mirror, from one image.

    One view. An unknown reflectance of texture_resolution² texels, initially grey, with LargeSteps. A part of the back is not visible at
    all. Paths from the mirror to the globe and on to the light have 7 segments.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    reference_spp: int = fields.reference_spp(512)
    max_depth: int = fields.max_depth(9, at_least=7)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the globe around the origin, with the mirror behind it at its left, oriented so that the camera sees the globe in its
        centre."""
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
        """Return the texture, initially grey."""
        return (Parameter("globe.bsdf.reflectance.data", initial=0.5, preconditioner=LargeSteps(1.0)),)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
