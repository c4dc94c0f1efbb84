"""Problem `lamp`: brightness and colour of a lamp together with a mural on the wall next to it.

Light and albedo multiply: a mural of half the albedo under a lamp of twice the radiance looks the same. They are distinguished by the
bulb, which the camera sees, and by the plaster and the floor, whose albedos are known.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, textures
from unrender.losses import Loss, RelativeL2
from unrender.scene.parameter import Parameter

_BULB = np.array([0.86, 1.68, -0.25])
"""Centre of the bulb."""


@register(name="lamp", position=4)
@dataclass(frozen=True)
class Lamp:
    """The radiance of a hanging lamp together with the mural that it lights.

    One view. Two unknowns: the lamp's colour (3,), initially dim white, and the mural (texture_resolution², 3), initially grey.
    """

    resolution: int = fields.resolution(128)
    texture_resolution: int = fields.texture_resolution(64)
    reference_spp: int = fields.reference_spp(384)
    max_depth: int = fields.max_depth(6, at_least=2)
    loss: Loss = field(default=RelativeL2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room: x in [-1.6, 1.6], y in [0, 2.2], z in [-1.2, 2.6], with the camera at its front, looking along -z."""
        plaster = parts.diffuse(0.7)
        mural = textures.bitmap(textures.photograph("coffee", self.texture_resolution))
        return {
            "type": "scene",
            "camera": parts.camera((0, 1.05, 2.5), (0, 1.05, -1.2), 47.0, self.resolution),
            "mural": parts.rectangle(
                (-0.5, 1.1, -1.199), (0.95, 0, 0), (0, 0.95, 0), {"type": "diffuse", "reflectance": mural}
            ),
            "back": parts.rectangle((0, 1.1, -1.2), (1.6, 0, 0), (0, 1.1, 0), plaster),
            "left": parts.rectangle((-1.6, 1.1, 0.7), (0, 0, -1.9), (0, 1.1, 0), plaster),
            "right": parts.rectangle((1.6, 1.1, 0.7), (0, 0, 1.9), (0, 1.1, 0), plaster),
            "front": parts.rectangle((0, 1.1, 2.6), (-1.6, 0, 0), (0, 1.1, 0), plaster),
            "floor": parts.rectangle((0, 0, 0.7), (1.6, 0, 0), (0, 0, -1.9), parts.diffuse(0.35, 0.25, 0.18)),
            "ceiling": parts.rectangle((0, 2.2, 0.7), (1.6, 0, 0), (0, 0, 1.9), plaster),
            "bulb": {
                "type": "sphere",
                "center": list(_BULB),
                "radius": 0.12,
                "bsdf": parts.diffuse(0.0),
                "emitter": parts.light(60.0, 45.0, 28.0),
            },
            "shade": meshes.sheet(
                "shade", _shade_points(48), parts.twosided(parts.diffuse(0.6, 0.3, 0.2)), closed=True
            ),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the lamp's radiance, whose scale needs its own learning rate, and the mural."""
        return (
            Parameter("bulb.emitter.radiance.value", initial=20.0, learning_rate=0.5),
            Parameter("mural.bsdf.reflectance.data", initial=0.5),
        )


def _shade_points(columns: int) -> np.ndarray:
    """Return a cone, closed at the top, whose lower edge is level with the centre of the bulb."""
    radius = np.array([0.34, 0.3, 0.26, 0.22, 0.18, 0.14, 0.07, 1e-3])
    height = np.array([0.0, 0.06, 0.12, 0.18, 0.24, 0.3, 0.31, 0.31])
    return meshes.lathe(radius, height, columns) + _BULB
