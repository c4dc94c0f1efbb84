"""Problem `mirror-trio`: the roughness of a mirror, from its reflection of three diffuse objects.

The variance experiment of adaptive pixel sampling (Fig. 3 of its paper). One number is unknown, and only pixels of the mirror contain
information about it, most of all the edges of reflections and the blurred reflections of lamps.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.losses import L2, Loss
from unrender.scene.parameter import Parameter

_ALPHA = 0.06
"""True roughness of the mirror."""

_LAMPS = {
    "warm": ((-1.9, 1.9, 0.0), (21.0, 17.0, 12.0)),
    "cool": ((1.9, 2.0, 0.1), (12.0, 16.0, 21.0)),
    "near": ((0.3, 1.8, 3.2), (17.0, 15.0, 12.5)),
}
"""Position and radiance: at both sides of the objects, to light their backs, and near the camera, visible in the mirror."""


@register(name="mirror-trio", position=8)
@dataclass(frozen=True)
class MirrorTrio:
    """The roughness of a mirror behind three diffuse objects, from an image of which it covers a part.

    One view. One unknown, the alpha of a rough conductor, a number. Path gradients reach it well. The difficulty is to sample the few
    informative pixels, some of which are also noisy.
    """

    resolution: int = fields.resolution(64)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(5, at_least=3)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the objects on a floor y = 0 around z = 0, the mirror at z = -1 before a wall, and the camera at z = 4."""
        silver = {"type": "roughconductor", "material": "Ag", "alpha": _ALPHA, "distribution": "ggx"}
        cone = meshes.lathe(*_cone(48), 64) + np.array([-0.02, 0.0, 0.15])
        return {
            "type": "scene",
            "camera": parts.camera((0.0, 1.25, 4.0), (0.0, 0.68, 0.0), 34.0, self.resolution),
            "sky": {"type": "constant", "radiance": parts.colour(0.12)},
            "floor": parts.rectangle((0, 0, 0), (6, 0, 0), (0, 0, -6), parts.diffuse(0.42, 0.36, 0.3)),
            "wall": parts.rectangle((0, 2, -1.3), (6, 0, 0), (0, 2, 0), parts.diffuse(0.3, 0.36, 0.4)),
            "mirror": parts.rectangle((0.1, 0.95, -1.0), (0.5, 0, 0), (0, 0.4, 0.03), silver),
            "frame": parts.rectangle(
                (0.1, 0.95, -1.02), (0.56, 0, 0), (0, 0.46, 0.035), parts.diffuse(0.1, 0.06, 0.04)
            ),
            "ball": {
                "type": "sphere",
                "center": [-0.78, 0.34, 0.1],
                "radius": 0.34,
                "bsdf": parts.diffuse(0.75, 0.12, 0.08),
            },
            "cone": meshes.sheet("cone", cone, parts.twosided(parts.diffuse(0.85, 0.6, 0.1)), closed=True),
            "block": {
                "type": "cube",
                "to_world": _block((0.8, 0.28, 0.1), 0.28),
                "bsdf": parts.diffuse(0.1, 0.3, 0.65),
            },
            **{name: _lamp(np.array(place), radiance) for name, (place, radiance) in _LAMPS.items()},
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the roughness, initially satin; from 0.25 on the loss decreases in the wrong direction."""
        return (Parameter("mirror.bsdf.alpha.value", initial=0.15, bounds=(0.01, 1.0)),)


def _lamp(place: np.ndarray, radiance: parts.Vector) -> dict[str, Any]:
    """Return a square light that faces the objects."""
    towards = np.array([0, 0.5, 0]) - place
    towards /= np.linalg.norm(towards)
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    up = np.cross(towards, right)
    return parts.rectangle(place, 0.28 * right, 0.28 * up, parts.diffuse(0.0), emitter=parts.light(*radiance))


def _cone(rows: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0, 1, rows)
    return 0.32 * (1 - t) + 1e-3, 0.85 * t


def _block(centre: parts.Vector, half: float) -> Any:
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 28)
    return mi.ScalarTransform4f().translate(list(centre)) @ turn @ mi.ScalarTransform4f().scale(half)
