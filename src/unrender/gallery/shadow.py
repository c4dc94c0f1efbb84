"""Problem `shadow`: the position of a floating ball outside of the image, from its shadow on the floor.

After Wang et al., section 4. A shadow caster gets no path gradient from its shadow, because visibility is discontinuous. Where the shadow
does not overlap its true position, even the true loss is flat.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, parts, staging
from unrender.losses import L2, Loss
from unrender.scene.parameter import Parameter

_SUN = np.array([0.4, 1.0, -0.25])
_HEIGHT = 4.0
_RADIUS = 0.32
_TRUTH, _START = (0.4, -0.3), (-0.45, 0.35)
"""True centre of the shadow: x and z."""
_REACH = 0.6
"""Largest distance of the shadow from the centre of the image, in x and in z."""


@register(name="shadow", position=18)
@dataclass(frozen=True)
class Shadow:
    """The position of a ball outside of the image: two numbers, from its shadow, initially away from the true one.

    One view. The unknowns are x and z of the ball's translation, bounded so that its shadow is in the image. A plateau: the loss does not
    change until the shadows overlap. The renderer's path gradient is zero everywhere.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the floor y = 0, with the camera below the ball, looking straight down, so that the shadow's shape does not change."""
        above = (0, 3.2, 0)
        x, z = np.array(_TRUTH) + _HEIGHT * _SUN[[0, 2]] / _SUN[1]
        return {
            "type": "scene",
            "camera": parts.camera(above, (0, 0, 0), 35.0, self.resolution)
            | {"to_world": mi.ScalarTransform4f().look_at(list(above), [0, 0, 0], [0, 0, -1])},
            "sun": staging.sun(_SUN, 1.2),
            "floor": parts.rectangle((0, 0, 0), (6, 0, 0), (0, 0, -6), parts.diffuse(0.6, 0.5, 0.35)),
            "ball": {
                "type": "sphere",
                "center": [float(x), _HEIGHT, float(z)],
                "radius": _RADIUS,
                "bsdf": parts.diffuse(0.5),
            },
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the ball's position above the floor, relative to the truth."""
        unknowns: list[Parameter] = []
        for axis, truth, start in zip("xz", _TRUTH, _START, strict=True):
            unknowns += staging.unknown("ball", "translation", {axis: start - truth}, (-_REACH - truth, _REACH - truth))
        return tuple(unknowns)
