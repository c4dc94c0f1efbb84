from dataclasses import dataclass, field

import unrender as ur
from unrender.gallery import fields, parts


@ur.register(name="painted-wall")
@dataclass(frozen=True)
class PaintedWall:
    """The colour of a wall under an even sky."""

    resolution: int = fields.resolution(32)
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: ur.losses.Loss = field(default=ur.losses.L2(), metadata=fields.LOSS)

    def scene(self):
        return {
            "type": "scene",
            "camera": parts.camera((0, 0, 2), (0, 0, 0), 40.0, self.resolution),
            "sky": {"type": "constant"},
            "wall": {"type": "rectangle", "bsdf": parts.diffuse(0.6, 0.4, 0.3)},
        }

    def parameters(self):
        return (ur.Parameter("wall.bsdf.reflectance.value", initial=0.5),)
