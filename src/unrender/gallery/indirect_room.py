"""Problems `indirect-room` and `wall`: a photograph in a closed room that is lit only via its ceiling.

A lamp on the floor points up, in a shade that is black inside. Only the ceiling sees it. From anywhere else no emitter can be sampled,
and with few samples per pixel the image is mostly noise. With the L1 loss this noise also biases the gradient of a plain loop.

`wall` is the simplest texture problem with noise. Sixteen pixels show every texel, and the best step of each is nearly known from the
image alone. Without noise, a few steps of the right length would suffice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from unrender.core.registry import register
from unrender.gallery import fields, parts, textures
from unrender.losses import L1, Loss
from unrender.preconditioners import LargeSteps
from unrender.scene.parameter import Parameter


@register(name="indirect-room", position=1)
@dataclass(frozen=True)
class IndirectRoom:
    """A photograph on the back wall of a room that is lit only by light bounced off its ceiling.

    One view. One unknown, the wall's reflectance (texture_resolution², 3), initially grey, with LargeSteps.
    """

    resolution: int = fields.resolution(128)
    texture_resolution: int = fields.texture_resolution(64)
    reference_spp: int = fields.reference_spp(1536)
    max_depth: int = fields.max_depth(6, at_least=3)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room: x and y in [-1, 1], z in [-1, 2.2], with the camera inside, looking along -z."""
        picture = textures.bitmap(textures.photograph("astronaut", self.texture_resolution))
        room = parts.room(parts.diffuse(0.75), parts.diffuse(0.6, 0.08, 0.06), parts.diffuse(0.12, 0.42, 0.1))
        return {
            "type": "scene",
            "camera": parts.camera((0, 0, 2.1), (0, 0, -1), 40.0, self.resolution),
            **room,
            "back": parts.rectangle((0, 0, -1), (1, 0, 0), (0, 1, 0), {"type": "diffuse", "reflectance": picture}),
            **parts.uplight((0.0, -0.999, 0.5), (40e3, 36e3, 30e3)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the wall's texture, initially grey, with LargeSteps as in the paper's reconstruction (Fig. 9)."""
        return (Parameter("back.bsdf.reflectance.data", initial=0.5, preconditioner=LargeSteps(2.0)),)


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
        return (Parameter("back.bsdf.reflectance.data", initial=0.5),)
