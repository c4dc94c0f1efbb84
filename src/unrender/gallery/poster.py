"""`poster`: the grey texture of a poster in direct light, many unknowns that hardly touch one another.

TEXTURE of Wang et al., section 4: what shows how derivatives from perturbed renders fare as dimensions grow, and why no n × n matrix
may be formed. Path gradients, which cost the same for any number of texels, solve it with ease.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, parts, textures
from unrender.losses import L2, Loss
from unrender.scene.parameter import Parameter


@register(name="poster", position=20)
@dataclass(frozen=True)
class Poster:
    """The grey texture of a poster that a lamp lights directly.

    One view; one unknown, the reflectance (texture_resolution², 1), from one grey: 1024 numbers by default. The loss is a convex
    quadratic in them, smooth and without a plateau; their number is what is hard where derivatives come from perturbations. Texels are
    not blended: with as many pixels each has its own, and the Hessian is diagonal.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """The poster: x and y in [-1, 1] at z = 0, filling the picture; the lamp before it, above the camera's field."""
        picture = textures.photograph("astronaut", self.texture_resolution).mean(axis=2, keepdims=True)
        # Texels are squares. Between texels blended into one another no picture tells the finest pattern from the grey that it averages to.
        texels = textures.bitmap(picture.astype(np.float32)) | {"filter_type": "nearest"}
        paint = {"type": "diffuse", "reflectance": texels}
        down = np.array([0.0, -0.6, -0.8])
        return {
            "type": "scene",
            "camera": parts.camera((0, 0, 4), (0, 0, 0), 2 * np.degrees(np.arctan(0.25)), self.resolution),
            "poster": parts.rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0), paint),
            "lamp": parts.rectangle(
                (0, 1.8, 2.4),
                (0.5, 0, 0),
                0.3 * np.cross(down, [1.0, 0, 0]),
                parts.diffuse(0.0),
                emitter=parts.light(32.0, 32.0, 32.0),
            ),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """The texture, grey at first."""
        return (Parameter("poster.bsdf.reflectance.data", initial=0.5),)
