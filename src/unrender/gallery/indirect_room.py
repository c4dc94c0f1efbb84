"""`indirect-room`: a photograph on the back wall of a closed room that is lit by nothing but its ceiling.

A lamp on the floor points up, in a shade that is black inside. The ceiling alone sees it: from anywhere else no emitter
can be sampled, and at few samples per pixel the picture is mostly noise. With the L1 loss that noise also biases the
gradient of a plain loop.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from unrender.gallery import fields, parts, textures
from unrender.losses import L1, Loss
from unrender.preconditioners import LargeSteps
from unrender.problem.parameter import Parameter


@dataclass(frozen=True)
class IndirectRoom:
    """A photograph on the back wall of a room that is lit only by light bounced off its ceiling.

    One view; one unknown, the wall's reflectance (texture_resolution², 3), from grey, with LargeSteps.
    """

    resolution: int = fields.resolution(128)
    texture_resolution: int = fields.texture_resolution(64)
    reference_spp: int = fields.reference_spp(4096)
    max_depth: int = fields.max_depth(6, at_least=3)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """The room: x and y in [-1, 1], z in [-1, 2.2]; the camera inside, looking along -z."""
        white, red, green = parts.diffuse(0.75), parts.diffuse(0.6, 0.08, 0.06), parts.diffuse(0.12, 0.42, 0.1)
        picture = textures.bitmap(textures.photograph("astronaut", self.texture_resolution))
        return {
            "type": "scene",
            "camera": parts.camera((0, 0, 2.1), (0, 0, -1), 40.0, self.resolution),
            "back": parts.rectangle((0, 0, -1), (1, 0, 0), (0, 1, 0), {"type": "diffuse", "reflectance": picture}),
            "left": parts.rectangle((-1, 0, 0.6), (0, 0, -1.6), (0, 1, 0), red),
            "right": parts.rectangle((1, 0, 0.6), (0, 0, 1.6), (0, 1, 0), green),
            "front": parts.rectangle((0, 0, 2.2), (-1, 0, 0), (0, 1, 0), white),
            "floor": parts.rectangle((0, -1, 0.6), (1, 0, 0), (0, 0, -1.6), white),
            "ceiling": parts.rectangle((0, 1, 0.6), (1, 0, 0), (0, 0, 1.6), white),
            **_lamp(),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """The wall's texture, grey at first, smoothed by LargeSteps as in the paper's own reconstruction (Fig. 9)."""
        return (Parameter("back.bsdf.reflectance.data", initial=0.5, preconditioner=LargeSteps(2.0)),)


def _lamp() -> dict[str, Any]:
    """An uplight on the floor: a small square light at the bottom of a wide box that is open above.

    From an edge of the light over the opposite edge of the box, light reaches the ceiling at most
    2 (half + opening) / height - half = 0.94 aside of the lamp's axis: no wall sees any of it. The sides are seen from
    outside only; inside they are black.
    """
    x, y, z = 0.0, -0.999, 0.5
    half, opening, height = 0.03, 0.115, 0.3
    metal = parts.diffuse(0.4)
    pieces = {
        "light": parts.rectangle(
            (x, y, z), (half, 0, 0), (0, 0, -half), parts.diffuse(0.0), emitter=parts.light(40e3, 36e3, 30e3)
        )
    }
    for name, (dx, dz) in {"left": (-1, 0), "right": (1, 0), "near": (0, 1), "far": (0, -1)}.items():
        pieces[f"shade_{name}"] = parts.rectangle(
            (x + opening * dx, y + height / 2, z + opening * dz),
            (opening * dz, 0, -opening * dx),
            (0, height / 2, 0),
            metal,
        )
    return pieces
