"""Problem `sun-glossy`: the paint under the lacquer of a wooden doll, in the sun.

The comparison of losses for adaptive pixel sampling (Fig. 4 of its paper). The lacquer reflects the sun: a few pixels are many times
brighter than the others and dominate L2, whereas a relative loss includes the shaded side.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, textures
from unrender.losses import L2, Loss
from unrender.preconditioners import LargeSteps
from unrender.scene.parameter import Parameter

_SUN = np.array([0.5, 0.55, 0.67]) / np.linalg.norm([0.5, 0.55, 0.67])
"""Direction to the sun."""


@register(name="sun-glossy", position=9)
@dataclass(frozen=True)
class SunGlossy:
    """The painted albedo of a glossy doll under a sky with a small bright sun, seen from all sides.

    Several views. One unknown, the diffuse reflectance (texture_resolution², 3) of a rough plastic, initially grey, with LargeSteps.
    Losses of interest are L2 and RelativeL2.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(48)
    views: int = fields.integer(4, "cameras, at equal angles around the doll", at_least=1, at_most=32)
    reference_spp: int = fields.reference_spp(512)
    max_depth: int = fields.max_depth(4, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the doll, 1.7 high, on the ground y = 0 around the y axis, facing +z."""
        angles = 0.35 + 2 * np.pi * np.arange(self.views) / self.views
        lacquer = {
            "type": "roughplastic",
            "diffuse_reflectance": textures.bitmap(_painting(self.texture_resolution)),
            "alpha": 0.05,
        }
        return {
            "type": "scene",
            **parts.cameras_around(angles, 4.2, (1.7,), (0, 0.84, 0), 27.0, self.resolution),
            "sky": parts.environment(parts.picture(_SUN, np.radians(2.5), (500.0, 450.0, 370.0))),
            "ground": parts.rectangle((0, 0, 0), (60, 0, 0), (0, 0, -60), parts.diffuse(0.3, 0.27, 0.22)),
            "doll": meshes.sheet("doll", meshes.lathe(*_profile(96), 96), lacquer, closed=True),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the paint, initially grey."""
        return (Parameter("doll.bsdf.diffuse_reflectance.data", initial=0.4, preconditioner=LargeSteps(1.0)),)


def _profile(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radius and height of body, waist and head, closed at the top."""
    from scipy.interpolate import PchipInterpolator

    knots = np.array(
        [(0, 0.4), (0.12, 0.52), (0.32, 0.58), (0.52, 0.48), (0.62, 0.37), (0.72, 0.39), (0.84, 0.34), (0.93, 0.22)]
    )
    height = 1 - (1 - np.linspace(0, 1, rows)) ** 1.5  # more rows near the top, where the profile turns inward
    body = PchipInterpolator(*knots.T)(np.minimum(height, 0.93))
    cap = 0.22 * np.sqrt(np.clip(1 - ((height - 0.93) / 0.07) ** 2, 1e-4, None))
    return np.where(height > 0.93, cap, body), 1.7 * height


def _painting(resolution: int) -> np.ndarray:
    """Return a face in a scarf, an apron with flowers and a skirt with dots, seamless in u: (resolution, resolution, 3), v = 1 first."""
    u, v = textures.grid(resolution)
    v = 1 - v**1.5  # height, as the profile's rows have it
    skirt, scarf, skin, white = ([0.65, 0.06, 0.05], [0.85, 0.5, 0.06], [0.85, 0.62, 0.45], [0.85, 0.83, 0.75])
    black, leaf, blue, pink = [0.05, 0.04, 0.04], [0.08, 0.35, 0.1], [0.06, 0.15, 0.5], [0.85, 0.25, 0.3]

    def spot(u0: float, v0: float, radius: float, stretch: float = 1.6) -> np.ndarray:
        distance = np.hypot((u - u0) * stretch, v - v0)
        return 1 - textures.ramp(distance, radius - 0.012, radius + 0.012)

    def band(low: float, high: float) -> np.ndarray:
        return textures.ramp(v, low - 0.012, low + 0.012) * (1 - textures.ramp(v, high - 0.012, high + 0.012))

    lattice = np.hypot(((12 * u) % 1 - 0.5) / 12 * 1.8, (v * 8 % 1 - 0.5) / 8)
    dots = 1 - textures.ramp(lattice, 0.025, 0.045)
    petals = sum(spot(0.5 + 0.055 * np.cos(a), 0.32 + 0.085 * np.sin(a), 0.055) for a in 2 * np.pi * np.arange(5) / 5)
    layers = [
        (dots * band(0.0, 0.58), scarf),
        (band(-0.1, 0.05), black),
        (spot(0.5, 0.3, 0.24), white),
        (spot(0.4, 0.2, 0.05) + spot(0.6, 0.2, 0.05), leaf),
        (np.clip(petals, 0, 1), pink),
        (spot(0.5, 0.32, 0.04), scarf),
        (band(0.6, 1.2), scarf),
        (band(0.6, 0.64), blue),
        (dots * band(0.66, 0.94), blue),
        (spot(0.5, 0.77, 0.12, 0.9), black),
        (spot(0.5, 0.765, 0.105, 0.9), skin),
        (spot(0.45, 0.79, 0.022) + spot(0.55, 0.79, 0.022), black),
        (spot(0.5, 0.72, 0.022, 0.8), skirt),
    ]
    picture = np.broadcast_to(skirt, (resolution, resolution, 3))
    for cover, paint in layers:
        picture = picture + (np.asarray(paint) - picture) * np.clip(cover, 0, 1)[..., None]
    return picture.astype(np.float32)
