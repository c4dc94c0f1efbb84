"""Problem `stage-lights`: the direction of a spotlight, the position of a softbox and the rotation of a projector, from one image."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi

from unrender.core.registry import register
from unrender.gallery import fields, parts, textures
from unrender.losses import L2, Loss
from unrender.scene.parameter import Parameter

_START: dict[str, tuple[str, dict[str, float]]] = {
    "spot": ("rotation", {"x": 0.15, "z": -0.12}),
    "softbox": ("translation", {"x": -0.4, "y": 0.3, "z": 0.2}),
    "beamer": ("rotation", {"x": 0.05, "y": 0.05}),
}


@register(name="stage-lights", position=33)
@dataclass(frozen=True)
class StageLights:
    """The direction of a spotlight, the position of a softbox and the rotation of a projector, from one image of a stage.

    One view. Seven unknowns: two angles of the spotlight, whose rotation about its own axis has no effect, the softbox's translation, and
    two angles of the projector. None of the lights is visible itself.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(3, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the stage: x in [-2, 2], z in [-1.5, 2], a backdrop at z = -1.5, two blocks, and the camera at its front, looking along
        -z."""
        place = mi.ScalarTransform4f
        picture = textures.bitmap(textures.photograph("coffee", 8))
        return {
            "type": "scene",
            "camera": parts.camera((0, 1.6, 5.0), (0, 0.6, -0.5), 42.0, self.resolution),
            "floor": parts.rectangle((0, 0, 0.25), (2, 0, 0), (0, 0, -1.75), parts.diffuse(0.6, 0.5, 0.4)),
            "backdrop": parts.rectangle((0, 1.25, -1.5), (2, 0, 0), (0, 1.25, 0), parts.diffuse(0.7)),
            "block": {
                "type": "cube",
                "to_world": place().translate([-0.7, 0.3, -0.2]).rotate([0, 1, 0], 30).scale(0.3),
                "bsdf": parts.diffuse(0.3, 0.4, 0.6),
            },
            "pillar": {
                "type": "cube",
                "to_world": place().translate([0.8, 0.5, 0.1]).scale([0.15, 0.5, 0.15]),
                "bsdf": parts.diffuse(0.6, 0.3, 0.3),
            },
            "spot": {
                "type": "spot",
                "to_world": place().look_at([0, 4, 2.5], [-0.6, 0, 0], [1, 0, 0]),
                "intensity": parts.colour(22.0, 16.0, 9.0),
                "cutoff_angle": 20.0,
            },
            "softbox": {
                "type": "rectangle",
                "to_world": place().translate([0.9, 2.4, 1.0]).rotate([1, 0, 0], 90).scale(0.35),
                "bsdf": parts.diffuse(0.0),
                "emitter": parts.light(9.0, 11.0, 14.0),
            },
            "beamer": {
                "type": "projector",
                "to_world": place().look_at([0, 1.5, 3.5], [0.3, 1.4, -1.5], [0, 1, 0]),
                "irradiance": picture,
                "fov": 28.0,
                "scale": 12.0,
            },
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the lights' poses, initially a rough guess."""
        unknowns: list[Parameter] = []
        for light, (part, start) in _START.items():
            unknowns += parts.unknown_pose(light, part, start)
        return tuple(unknowns)
