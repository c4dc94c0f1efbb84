"""Problem `chalice`: the roughness of a metal cup under small, bright lamps, a hard case for finite differences.

After Balint et al. 2023, Fig. 9. A small light samples the edge of the lobe. A small change of roughness moves this edge across several
pixels, so the relative change of a sample is large, and roughness also affects the sampling. Differences of gradients are then as noisy
as gradients.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, textures
from unrender.losses import Loss, RelativeL2
from unrender.preconditioners import LargeSteps
from unrender.scene.parameter import Parameter

_LIGHTS = ((-1.4, 2.6, 1.6), (1.5, 2.2, 1.2), (0.2, 2.9, 2.2), (-1.9, 1.2, 0.4), (2.0, 1.0, 0.2), (0.0, 2.4, -1.2))


@register(name="chalice", position=7)
@dataclass(frozen=True)
class Chalice:
    """The roughness map of a metal chalice under small, bright lights.

    Two views. One unknown, the roughness (texture_resolution², 1), initially constant, with LargeSteps.
    """

    resolution: int = fields.resolution(96)
    texture_resolution: int = fields.texture_resolution(64)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(4, at_least=2)
    loss: Loss = field(default=RelativeL2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the chalice, 1.5 high, on a table y = 0 around the y axis, with six lamps of the size of a coin above and around it."""
        return {
            "type": "scene",
            "camera_0": parts.camera((0.0, 1.5, 3.6), (0, 0.75, 0), 30.0, self.resolution),
            "camera_1": parts.camera((2.9, 1.3, 2.1), (0, 0.75, 0), 30.0, self.resolution),
            "sky": {"type": "constant", "radiance": parts.colour(0.03)},
            "table": parts.rectangle((0, 0, 0), (4, 0, 0), (0, 0, -4), parts.diffuse(0.25, 0.2, 0.16)),
            "chalice": meshes.sheet(
                "chalice", meshes.lathe(*_profile(160), 160), _silver(self.texture_resolution), closed=True
            ),
            **{f"lamp_{number}": _lamp(np.array(place)) for number, place in enumerate(_LIGHTS)},
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the roughness, initially constant."""
        return (Parameter("chalice.bsdf.brdf_0.roughness.data", initial=0.65, preconditioner=LargeSteps(2.0)),)


def _lamp(place: np.ndarray) -> dict[str, Any]:
    """Return a coin-sized square light that faces the centre of the chalice."""
    towards = np.array([0, 0.75, 0]) - place
    towards /= np.linalg.norm(towards)
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    up = np.cross(towards, right)
    return parts.rectangle(place, 0.04 * right, 0.04 * up, parts.diffuse(0.0), emitter=parts.light(500.0, 470.0, 420.0))


def _profile(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radius and height of foot, stem with a knot, and bowl."""
    from scipy.interpolate import PchipInterpolator

    height = np.linspace(0, 1, rows)
    knots = [
        (0, 0.42),
        (0.03, 0.42),
        (0.08, 0.2),
        (0.18, 0.09),
        (0.26, 0.15),
        (0.34, 0.08),
        (0.46, 0.2),
        (0.62, 0.44),
        (1, 0.52),
    ]
    return PchipInterpolator(*np.array(knots).T)(height), 1.5 * height


def _silver(resolution: int) -> dict[str, Any]:
    u, v = textures.grid(resolution)
    worn = 0.5 + 0.5 * np.sin(2 * np.pi * (6 * u + 2 * np.sin(2 * np.pi * v))) * np.cos(2 * np.pi * 3 * v)
    return parts.twosided(
        {
            "type": "principled",
            "base_color": parts.colour(0.85, 0.82, 0.75),
            "metallic": 1.0,
            "roughness": textures.bitmap(0.2 + 0.45 * worn),
        }
    )
