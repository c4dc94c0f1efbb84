"""`sunlit-vase`: the glaze of a vase that stands in the sun, seen from all around.

The sun is small and a thousand times brighter than the sky: the lit side of the vase is easy, its shaded side is lit by
the sky and by what the ground gives back, while most emitter samples go to the sun and are lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, skies, textures
from unrender.losses import L1, Loss
from unrender.scene.parameter import Parameter

__all__ = ["SUN", "SunlitVase", "vase"]

SUN = np.array([-0.55, 0.62, 0.56]) / np.linalg.norm([-0.55, 0.62, 0.56])
"""Direction to the sun."""
_SUN_RADIUS = np.radians(2.5)


@register(name="sunlit-vase", position=3)
@dataclass(frozen=True)
class SunlitVase:
    """The painted glaze of a vase under a sky with a small bright sun, seen from all around.

    Several views; one unknown, the base colour (texture_resolution², 3), from grey.
    """

    resolution: int = fields.resolution(128)
    texture_resolution: int = fields.texture_resolution(64)
    views: int = fields.integer(3, "cameras, evenly around the vase", at_least=1, at_most=16)
    reference_spp: int = fields.reference_spp(384)
    max_depth: int = fields.max_depth(5, at_least=2)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """The vase: 1.7 high, on the ground y = 0, around the y axis."""
        angles = np.pi / 6 + 2 * np.pi * np.arange(self.views) / self.views
        gravel = textures.bitmap(textures.photograph("gravel", 128), repeat=(10, 10))
        return {
            "type": "scene",
            **{
                f"camera_{number}": parts.camera(
                    (4.2 * np.sin(a), 1.9, 4.2 * np.cos(a)), (0, 0.82, 0), 28.0, self.resolution
                )
                for number, a in enumerate(angles)
            },
            "sky": skies.environment(_sky()),
            "ground": parts.rectangle((0, 0, 0), (15, 0, 0), (0, 0, -15), {"type": "diffuse", "reflectance": gravel}),
            "vase": vase(self.texture_resolution),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """The glaze, grey at first."""
        return (Parameter("vase.bsdf.brdf_0.base_color.data", initial=0.5),)


def vase(texture_resolution: int) -> dict[str, Any]:
    """The vase alone, with its true glaze."""
    return meshes.sheet("vase", _vase_points(96, 96), _glaze(texture_resolution), closed=True)


def _sky() -> np.ndarray:
    """The sky and its sun: see `skies.picture`."""
    return skies.picture(SUN, _SUN_RADIUS, (620.0, 560.0, 460.0))


def _vase_points(rows: int, columns: int) -> np.ndarray:
    """A profile with a foot, a belly, a neck and a lip, turned about the y axis."""
    height = np.linspace(0, 1, rows)
    knots = np.array(
        [
            (0, 0.3),
            (0.04, 0.3),
            (0.1, 0.26),
            (0.3, 0.5),
            (0.5, 0.58),
            (0.68, 0.42),
            (0.84, 0.2),
            (0.94, 0.22),
            (1, 0.32),
        ]
    )
    from scipy.interpolate import PchipInterpolator

    radius = PchipInterpolator(*knots.T)(height)
    return meshes.lathe(radius, 1.7 * height, columns)


def _glaze(resolution: int) -> dict[str, Any]:
    paint = textures.bitmap(_painting(resolution))
    return parts.twosided({"type": "principled", "base_color": paint, "roughness": 0.35, "specular": 0.5})


def _painting(resolution: int) -> np.ndarray:
    """Bands, a zigzag, dots and petals on terracotta, without a seam in u: (resolution, resolution, 3), v = 1 first."""
    u, v = textures.grid(resolution)
    v = 1 - v
    clay, ink, cream, blue = (
        np.array(c) for c in ([0.6, 0.22, 0.1], [0.05, 0.05, 0.07], [0.85, 0.75, 0.55], [0.08, 0.25, 0.6])
    )

    def within(x: np.ndarray, low: float, high: float | np.ndarray) -> np.ndarray:
        edge = 0.012
        return textures.ramp(x, low - edge, low + edge) * (1 - textures.ramp(x, high - edge, high + edge))

    saw = np.abs((8 * u) % 1 - 0.5) * 2
    petals = np.sqrt(np.abs(np.sin(6 * np.pi * u)))
    dots = np.hypot(((12 * u) % 1 - 0.5) / 12 * 2.2, v - 0.66)
    layers = [
        (within(v, 0.0, 0.09), ink),
        (within(v, 0.12, 0.12 + 0.2), cream),
        (within(v, 0.12, 0.125 + 0.19 * petals), blue),
        (within(v, 0.38, 0.58), ink),
        (within(v - 0.08 * saw, 0.41, 0.475), cream),
        (1 - textures.ramp(dots, 0.025, 0.045), cream),
        (within(v, 0.72, 0.74), ink),
        (within(v, 0.8, 0.9), blue),
        (within(v, 0.94, 1.1), ink),
    ]
    picture = np.broadcast_to(clay, (resolution, resolution, 3))
    for cover, paint in layers:
        picture = picture + (paint - picture) * cover[..., None]
    return picture.astype(np.float32)
