"""Problem `plain-and-textured`: the colour of a waste bin and the texture of a cushion, in one room.

The case for several resolutions in adaptive pixel sampling (Fig. 5 of its paper). All pixels of the bin depend on the same three numbers,
whereas the pixels of the cushion depend on different ones. Judged individually, both seem to deserve as many samples, although the bin
needs almost none.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.core.rotations import rotation
from unrender.gallery import fields, meshes, parts, textures
from unrender.losses import L2, Loss
from unrender.preconditioners import LargeSteps
from unrender.scene.parameter import Parameter


@register(name="plain-and-textured", position=10)
@dataclass(frozen=True)
class PlainAndTextured:
    """The colour of a bin together with the texture of a cushion, in a room.

    One view. Two unknown reflectances, (3,) and (texture_resolution², 3), initially grey, the texture with LargeSteps.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    reference_spp: int = fields.reference_spp(512)
    max_depth: int = fields.max_depth(5, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room of `parts.room` with a lamp in its ceiling, and bin and cushion on its floor y = -1."""
        cover = {
            "type": "diffuse",
            "reflectance": textures.bitmap(textures.photograph("chelsea", self.texture_resolution)),
        }
        place = np.array([-0.46, -1.0, -0.3])
        return {
            "type": "scene",
            "camera": parts.camera((0.0, -0.05, 2.15), (0, -0.22, -0.4), 53.0, self.resolution),
            **parts.room(parts.diffuse(0.7, 0.68, 0.62), parts.diffuse(0.6, 0.1, 0.08), parts.diffuse(0.12, 0.4, 0.15)),
            "lamp": parts.rectangle(
                (0, 0.99, 0.1), (0.35, 0, 0), (0, 0, 0.35), parts.diffuse(0.0), emitter=parts.light(17.0, 15.5, 13.5)
            ),
            "bin": meshes.sheet(
                "bin", meshes.lathe(*_bin(40), 64) + place, parts.twosided(parts.diffuse(0.12, 0.3, 0.65)), closed=True
            ),
            "cushion": meshes.sheet("cushion", _cushion(33), parts.twosided(cover)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return both reflectances, initially grey."""
        return (
            Parameter("bin.bsdf.brdf_0.reflectance.value", initial=0.5),
            Parameter("cushion.bsdf.brdf_0.reflectance.data", initial=0.5, preconditioner=LargeSteps(1.0)),
        )


def _bin(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radius and height of a bin with a rim, open at the top, without a visible bottom."""
    t = np.linspace(0, 1, rows)
    return 0.26 + 0.1 * t + 0.03 * textures.ramp(t, 0.9, 0.94), 0.85 * t


def _cushion(steps: int) -> np.ndarray:
    """Return a pillow that leans back, rotated a little to the left: points (steps, steps, 3)."""
    y, x = np.meshgrid(np.linspace(-1, 1, steps), np.linspace(-1, 1, steps), indexing="ij")
    # Thin seams that curve inwards between the corners.
    bulge = 0.22 * np.sqrt(np.clip((1 - x**2) * (1 - y**2), 0, None))
    x, y = x * (1 - 0.08 * (1 - y**2)), y * (1 - 0.08 * (1 - x**2))
    flat = np.stack([0.47 * x, 0.47 * y, bulge], -1)
    back, aside = rotation((1, 0, 0), np.radians(-20)), rotation((0, 1, 0), np.radians(-18))
    return flat @ back.T @ aside.T + np.array([0.42, -0.53, 0.05])
