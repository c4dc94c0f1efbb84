"""`wall`: a picture that fills the film, of few texels, lit by bounced light alone.

The simplest problem of a texture under noise: every texel is seen by sixteen pixels, and the best step of each is known nearly exactly
from the picture alone. What a method needs for it beyond a few steps of the right length, it needs for the noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from unrender.core.registry import register
from unrender.gallery import fields, parts
from unrender.gallery.indirect_room import IndirectRoom
from unrender.losses import L1, Loss
from unrender.scene.parameter import Parameter


@register(name="wall", position=26)
@dataclass(frozen=True)
class Wall:
    """A photograph of few texels on a wall that fills the picture, lit only by bounced light.

    One view; one unknown, the wall's reflectance (texture_resolution², 3), from grey. The room is that of `indirect-room`.
    """

    resolution: int = fields.resolution(80)
    texture_resolution: int = fields.texture_resolution(20)
    reference_spp: int = fields.reference_spp(3072)
    max_depth: int = fields.max_depth(6, at_least=3)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """The room, and a camera whose picture ends where the wall does, 3.1 away and 2 wide."""
        room = IndirectRoom(texture_resolution=self.texture_resolution).scene()
        fov = math.degrees(2 * math.atan(1 / 3.1))
        return {**room, "camera": parts.camera((0, 0, 2.1), (0, 0, -1), fov, self.resolution)}

    def parameters(self) -> tuple[Parameter, ...]:
        """The wall's texture, grey at first."""
        return (Parameter("back.bsdf.reflectance.data", initial=0.5),)
