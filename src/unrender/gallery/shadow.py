"""`shadow`: where a ball floats that no camera sees, from its shadow on the floor.

After Wang et al., section 4. What casts a shadow gets no gradient through it, since visibility is a step; and where the shadow does not
overlap its place in the reference, even the true loss is flat.
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
"""Of the middle of the shadow: x and z."""
_REACH = 0.6
"""How far the shadow may be from the middle of the picture in x and in z."""


@register(name="shadow", position=18)
@dataclass(frozen=True)
class Shadow:
    """Where a ball outside the picture is: two numbers, from its shadow, which starts beside the one sought.

    One view; the unknowns are x and z of the ball's translation, kept where all of its shadow is in the picture. A plateau: the loss does
    not change until the shadows overlap. The renderer's path gradient is zero everywhere.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """The floor y = 0; the camera below the ball, looking straight down, so that the shadow looks the same wherever it is."""
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
        """The ball's place above the floor, from the truth."""
        found: list[Parameter] = []
        for axis, truth, start in zip("xz", _TRUTH, _START, strict=True):
            found += staging.unknown("ball", "translation", {axis: start - truth}, (-_REACH - truth, _REACH - truth))
        return tuple(found)
