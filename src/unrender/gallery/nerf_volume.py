"""Problem `nerf-volume`: an object with surfaces, fitted by a volume that emits and absorbs. After Balint et al. 2023, Figs 7 and 8.

The paper's Fig. 8 shows a sparser volume: `balls` has small balls far from each other.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, parts, staging, volumes
from unrender.gallery.specification import views_of
from unrender.losses import L2, Loss
from unrender.rendering.mitsuba.scene_loading import load
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem


@register(name="nerf-volume", position=25)
@dataclass(frozen=True)
class NerfVolume:
    """A toy of coloured balls and blocks, seen from all sides, fitted by a volume that emits and absorbs.

    Several views. The unknowns are extinction (grid_resolution³, 1) and emitted radiance (grid_resolution³, 3), initially a thin grey
    glow. There is no true value: the toy has surfaces, and its appearance depends on the direction.
    """

    resolution: int = fields.resolution(32)
    grid_resolution: int = fields.integer(16, "voxels along a side of each unknown grid", at_least=2)
    views: int = fields.integer(16, "cameras, at equal angles around the toy", at_least=1, at_most=64)
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(4, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)
    balls: int = fields.integer(
        0, "number of small coloured balls in place of the toy, a sparse volume; 0 for the toy", 0, 512
    )

    def scene(self) -> dict[str, Any]:
        """Return the initial volume in the cube [-1, 1]³."""
        size = (self.grid_resolution,) * 3
        density, glow = volumes.grid(np.full((*size, 1), 0.5)), volumes.grid(np.full((*size, 3), 0.4))
        return self._stage() | {"volume": volumes.cube({"type": "emissive", "sigma_t": density, "emission": glow})}

    def target(self) -> dict[str, Any]:
        """Return the toy, or the balls, in place of the volume, in the sun."""
        return (
            self._stage() | (_balls(self.balls) if self.balls else _toy()) | {"sun": staging.sun((0.5, 0.8, 0.4), 0.9)}
        )

    def parameters(self) -> tuple[Parameter, ...]:
        """Return both grids; extinction has the wider range, and larger steps."""
        return (
            Parameter("volume.interior_medium.sigma_t.data", learning_rate=0.2),
            Parameter("volume.interior_medium.emission.data"),
        )

    def problem(self, name: str) -> Problem:
        """Return the problem: the volume's scene, with direct emission only, and references of the toy by Mitsuba's `path` integrator."""
        return Problem(self.scene, self.parameters(), views_of(load(self.target), self), self.loss, 1, name=name)

    def _stage(self) -> dict[str, Any]:
        sky = {"type": "constant", "radiance": parts.colour(0.3, 0.35, 0.4)}
        return {"type": "scene", **volumes.around(self.views, self.resolution), "sky": sky}


def _toy() -> dict[str, Any]:
    import mitsuba as mi

    to = mi.ScalarTransform4f()
    red, blue, gold, green = ([0.75, 0.15, 0.1], [0.1, 0.25, 0.7], [0.8, 0.6, 0.15], [0.15, 0.55, 0.2])
    return {
        "base": {"type": "cube", "to_world": to.translate([0, -0.55, 0]).scale([0.6, 0.12, 0.6]), "bsdf": parts.diffuse(*blue)},
        "body": {"type": "sphere", "center": [0.0, -0.1, 0.0], "radius": 0.36, "bsdf": parts.diffuse(*red)},
        "head": {"type": "sphere", "center": [0.1, 0.4, 0.05], "radius": 0.22, "bsdf": parts.diffuse(*gold)},
        "arm": {"type": "cube", "to_world": to.translate([-0.35, 0.05, 0.2]).rotate([0, 0, 1], 35).scale([0.3, 0.08, 0.08]),
                "bsdf": parts.diffuse(*green)},
    }  # fmt: skip


def _balls(count: int) -> dict[str, Any]:
    """Return balls that fill a hundredth of the cube for any count; the toy fills about a thirteenth."""
    random = np.random.default_rng(8)
    radius = float((0.01 * 8 / (count * np.pi * 4 / 3)) ** (1 / 3))
    reach = min(0.85, 0.98 - radius)
    centers, colours = random.uniform(-reach, reach, (count, 3)), random.uniform(0.08, 0.8, (count, 3))
    return {
        f"ball_{n}": {
            "type": "sphere",
            "center": [float(x) for x in center],
            "radius": radius,
            "bsdf": parts.diffuse(*colour),
        }
        for n, (center, colour) in enumerate(zip(centers, colours.tolist(), strict=True))
    }
