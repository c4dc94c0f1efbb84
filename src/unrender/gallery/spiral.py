"""Problem `spiral`: a glossy spiral ribbon with unknown colour, metalness and roughness.

After Balint et al. 2023, Fig. 1. The three are correlated: from one side, a darker metal and a rougher dielectric look alike. Two shaded
lamps light the ribbon via the ceiling and the upper walls, and it reflects itself: every sample is noisy.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, textures
from unrender.losses import Loss, RelativeL2
from unrender.scene.parameter import Parameter

_TURNS = 2.5


@register(name="spiral", position=5)
@dataclass(frozen=True)
class Spiral:
    """Base colour, metalness and roughness of a glossy spiral ribbon, together, by indirect light.

    One view. Five unknown numbers, or three maps of texture_resolution² texels, initially constant.
    """

    resolution: int = fields.resolution(96)
    texture_resolution: int = fields.integer(1, "texels along a side of each unknown map; 1: no maps, plain values")
    reference_spp: int = fields.reference_spp(1536)
    max_depth: int = fields.max_depth(6, at_least=3)
    loss: Loss = field(default=RelativeL2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room: x and y in [-1, 1], z in [-1, 2.2], with the spiral around the y axis, and the camera inside, looking along
        -z."""
        return {
            "type": "scene",
            "camera": parts.camera((0, 0.55, 2.1), (0, -0.12, 0), 36.0, self.resolution),
            **parts.room(parts.diffuse(0.7), left=parts.diffuse(0.55, 0.2, 0.1), right=parts.diffuse(0.1, 0.3, 0.55)),
            **parts.uplight((-0.7, -0.999, 1.6), (40e3, 37e3, 33e3)),
            **parts.uplight((0.7, -0.999, -0.6), (22e3, 24e3, 30e3), name="second"),
            "spiral": meshes.sheet("spiral", _ribbon(24, 400), _lacquer(self.texture_resolution)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return colour, metalness and roughness."""
        leaf = "value" if self.texture_resolution == 1 else "data"
        start = {"base_color": 0.5, "metallic": 0.3, "roughness": 0.6}
        return tuple(Parameter(f"spiral.bsdf.brdf_0.{name}.{leaf}", initial=value) for name, value in start.items())


def _ribbon(rows: int, columns: int) -> np.ndarray:
    """Return a ribbon that climbs and narrows as it winds: points (rows, columns, 3)."""
    across, along = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    angle = 2 * np.pi * _TURNS * along
    radius = 0.62 - 0.32 * along
    height = -0.82 + 1.25 * along + 0.16 * across
    return np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=-1)


def _lacquer(resolution: int) -> dict[str, Any]:
    """Return copper or, for more than one texel, bands of copper and blue enamel with roughness increasing along the ribbon's width."""
    copper, blue = np.array([0.85, 0.42, 0.2]), np.array([0.08, 0.25, 0.5])
    if resolution == 1:
        unknown: dict[str, Any] = {"base_color": parts.colour(*copper), "metallic": 0.8, "roughness": 0.3}
    else:
        u, v = textures.grid(resolution)
        bands = textures.ramp(np.sin(6 * np.pi * u), -0.4, 0.4)[..., None]
        unknown = {
            "base_color": textures.bitmap(blue + (copper - blue) * bands),
            "metallic": textures.bitmap(0.1 + 0.8 * textures.ramp(np.cos(4 * np.pi * u), -0.5, 0.5)),
            "roughness": textures.bitmap(0.2 + 0.45 * v),
        }
    return parts.twosided({"type": "principled", **unknown})
