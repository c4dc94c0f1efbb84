"""Problem `poster`: the grey texture of a poster in direct light, with many nearly independent unknowns.

TEXTURE of Wang et al., section 4. It shows how derivatives from perturbed renders scale with the dimension, and why an n × n matrix must
not be formed. Path gradients, whose cost does not depend on the number of texels, solve it easily.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, parts, textures
from unrender.scene.parameter import Parameter


@register(name="poster", position=20)
@dataclass(frozen=True)
class Poster(fields.Rendered):
    """The grey texture of a poster in direct light.

    One view. One unknown, the reflectance (texture_resolution², 1), initially constant: 1024 numbers by default. The loss is a convex
    quadratic, smooth and without a plateau. The number of unknowns is the difficulty for derivatives from perturbations. Texels are not
    interpolated. If each pixel shows one texel, the Hessian is diagonal.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)

    def scene(self) -> dict[str, Any]:
        """Return the poster, x and y in [-1, 1] at z = 0, filling the image, with the lamp before it, above the field of view."""
        picture = textures.photograph("astronaut", self.texture_resolution).mean(axis=2, keepdims=True)
        # Texels are squares. With interpolation, no image would distinguish the finest pattern from its mean grey.
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
        return (Parameter("poster.bsdf.reflectance.data", initial=0.5),)
