"""Problem `smoke`: density and colour of a cloud of smoke, seen from all sides.

After Nicolet et al. 2023, Figs 5 and 11. Most of the cube is empty, and some of it dense, with multiple scattering. In a voxel that the
optimisation has emptied, collisions alone would never show that smoke is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, textures, volumes
from unrender.losses import L1, Loss
from unrender.scene.parameter import Parameter


@register(name="smoke", position=24)
@dataclass(frozen=True)
class Smoke:
    """Density and colour of a cloud of smoke under a bright sky, seen from all sides.

    Several views. The unknowns are extinction (grid_resolution³, 1) and albedo (grid_resolution³, 3), initially a thin grey fog.
    """

    resolution: int = fields.resolution(32)
    grid_resolution: int = fields.integer(16, "voxels along a side of each unknown grid", at_least=2)
    views: int = fields.integer(8, "cameras, at equal angles around the smoke", at_least=1, at_most=64)
    reference_spp: int = fields.reference_spp(512)
    max_depth: int = fields.max_depth(6, at_least=2)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the smoke in the cube [-1, 1]³."""
        density, colour = _smoke(self.grid_resolution)
        medium = {
            "type": "heterogeneous",
            "sigma_t": volumes.grid(density),
            "albedo": volumes.grid(colour),
            "phase": {"type": "isotropic"},
        }
        return {
            "type": "scene",
            **volumes.around(self.views, self.resolution, fov=30.0),
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(_sky()), "to_world": mi.ScalarTransform4f()},
            "smoke": volumes.cube(medium),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return both grids; extinction has the wider range, and larger steps."""
        return (
            Parameter("smoke.interior_medium.sigma_t.data", initial=0.4, learning_rate=0.1),
            Parameter("smoke.interior_medium.albedo.data", initial=0.6),
        )


def _smoke(resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Return extinction (Z, Y, X, 1), from 0 to about 6, and albedo (Z, Y, X, 3): a rising and spreading plume, ochre below, blue
    above."""
    x, y, z = volumes.positions(resolution)
    lean = 0.25 * np.sin(2 * y)
    radius = np.hypot(x - lean, z) / (0.55 + 0.25 * y)
    plume = textures.ramp(1.1 - radius, 0, 0.5) * textures.ramp(0.95 - np.abs(y), 0, 0.3)
    billows = textures.ramp(volumes.noise(resolution, 4, seed=1), 0.35, 0.75)
    density = 6 * plume * billows
    mix = textures.ramp(y + 0.6 * (volumes.noise(resolution, 2, seed=2) - 0.5), -0.6, 0.6)[..., None]
    colour = np.array([0.9, 0.7, 0.45]) * (1 - mix) + np.array([0.5, 0.7, 0.92]) * mix
    return density[..., None].astype(np.float32), colour.astype(np.float32)


def _sky() -> np.ndarray:
    """Return a latitude-longitude image with the zenith in its first row: bright and warm on one side, dim and blue on the other."""
    rows = 32
    theta = np.pi * (np.arange(rows)[:, None] + 0.5) / rows
    phi = 2 * np.pi * (np.arange(2 * rows)[None, :] + 0.5) / (2 * rows)
    towards = np.sin(theta) * np.cos(phi - 1.0) * 0.6 + np.cos(theta) * 0.8
    glow = np.exp(5 * (towards - 1))[..., None]
    return (np.array([0.16, 0.2, 0.28]) + glow * np.array([5.0, 4.2, 3.0])).astype(np.float32)
