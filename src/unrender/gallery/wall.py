"""Problem `wall`: an image of few texels that fills the film, lit by indirect light only.

The simplest texture problem with noise. Sixteen pixels show every texel, and the best step of each is nearly known from the image alone.
Without noise, a few steps of the right length would suffice.
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
    """A photograph of few texels on a wall that fills the image, lit only by indirect light.

    One view. One unknown, the wall's reflectance (texture_resolution², 3), initially grey. The room is that of `indirect-room`.
    """

    resolution: int = fields.resolution(80)
    texture_resolution: int = fields.texture_resolution(20)
    reference_spp: int = fields.reference_spp(3072)
    max_depth: int = fields.max_depth(6, at_least=3)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room, with a camera whose image ends at the edges of the wall, 3.1 away and 2 wide."""
        room = IndirectRoom(texture_resolution=self.texture_resolution).scene()
        fov = math.degrees(2 * math.atan(1 / 3.1))
        return {**room, "camera": parts.camera((0, 0, 2.1), (0, 0, -1), fov, self.resolution)}

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the wall's texture, initially grey."""
        return (Parameter("back.bsdf.reflectance.data", initial=0.5),)
