"""Problem `tea`: the medium in a glass ball, in a room that is lit only via its ceiling.

After Nicolet et al. 2023, section 6. Glass refracts every ray, so no emitter can be sampled from inside of the tea, and light is
indirect: with few samples the image is noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from unrender.core.registry import register
from unrender.gallery import fields, parts
from unrender.losses import L1, Loss
from unrender.scene.parameter import Parameter


@register(name="tea", position=23)
@dataclass(frozen=True)
class Tea:
    """Extinction and albedo of the tea in a glass ball, in a room lit only by light bounced off its ceiling.

    One view. Two unknowns (3,). The scene multiplies the extinction by 10, to inverse units of length.
    """

    resolution: int = fields.resolution(32)
    reference_spp: int = fields.reference_spp(2048)
    max_depth: int = fields.max_depth(12, at_least=4)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room of `indirect-room` without its photograph, with the ball before the back wall."""
        tea = {
            "type": "homogeneous",
            "scale": 10.0,  # Mitsuba limits colours to 1
            "sigma_t": parts.colour(0.25, 0.4, 0.7),
            "albedo": parts.colour(0.9, 0.72, 0.3),
            "sample_emitters": False,
        }
        room = parts.room(parts.diffuse(0.75), parts.diffuse(0.6, 0.08, 0.06), parts.diffuse(0.12, 0.42, 0.1))
        pot = {
            "type": "sphere",
            "center": [0.0, -0.5, 0.1],
            "radius": 0.5,
            "bsdf": {"type": "dielectric", "int_ior": 1.33},
        }
        return {
            "type": "scene",
            "camera": parts.camera((0, -0.1, 2.1), (0, -0.35, 0), 46.0, self.resolution),
            **room,
            "tea": pot | {"interior": tea},
            **parts.uplight((0.72, -0.999, 0.9), (40e3, 36e3, 30e3)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return both unknowns, initially thin and grey."""
        return (
            Parameter("tea.interior_medium.sigma_t.value.value", initial=0.15),
            Parameter("tea.interior_medium.albedo.value.value", initial=0.6),
        )
