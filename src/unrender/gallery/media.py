"""Problems `three-bodies` and `tea`: media and materials of balls. After Nicolet et al. 2023, Fig. 2 and section 6.

The tea is in a glass ball, in a room that is lit only via its ceiling. Glass refracts every ray, so no emitter can be sampled from
inside of the tea, and light is indirect: with few samples the image is noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from unrender.core.registry import register
from unrender.gallery import fields, parts
from unrender.losses import L1, Loss
from unrender.scene.parameter import Parameter


@register(name="three-bodies", position=22)
@dataclass(frozen=True)
class ThreeBodies:
    """Albedo, roughness and extinction of three balls: of paint, of metal and of fog.

    One view. The unknowns are a reflectance (3,), a roughness α () and an extinction (3,). The scene multiplies the extinction by 4, to
    inverse units of length.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(6, at_least=2)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return three balls of radius 0.6 on the floor y = -0.6, under a lamp and a sky."""
        tiles = {"type": "checkerboard", "color0": parts.colour(0.15), "color1": parts.colour(0.6)}
        tiles["to_uv"] = _scaled(24)
        fog = {
            "type": "homogeneous",
            "scale": 4.0,  # Mitsuba limits colours to 1
            "sigma_t": parts.colour(0.9, 0.6, 0.35),
            "albedo": parts.colour(0.6, 0.85, 0.95),
        }
        floor = parts.rectangle((0, -0.6, 0), (8, 0, 0), (0, 0, -8), {"type": "diffuse", "reflectance": tiles})
        return {
            "type": "scene",
            "camera": parts.camera((0, 1.3, 5.2), (0, -0.1, 0), 40.0, self.resolution),
            "floor": floor,
            "lamp": parts.rectangle(
                (-2.5, 3.5, 1), (0.8, -0.6, 0), (0, 0, 1), parts.diffuse(0), emitter=parts.light(9, 8, 6)
            ),
            "sky": {"type": "constant", "radiance": parts.colour(0.25, 0.3, 0.4)},
            "paint": _ball(-1.35, {"type": "diffuse", "reflectance": parts.colour(0.75, 0.25, 0.12)}),
            "metal": _ball(0.0, {"type": "roughconductor", "material": "Al", "alpha": 0.12}),
            "fog": _ball(1.35, {"type": "null"}) | {"interior": fog},
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the unknowns: grey paint, dull metal, thin grey fog."""
        return (
            Parameter("paint.bsdf.reflectance.value", initial=0.5),
            Parameter("metal.bsdf.alpha.value", initial=0.4),
            Parameter("fog.interior_medium.sigma_t.value.value", initial=0.2),
        )


def _ball(x: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "sphere", "center": [x, 0.0, 0.0], "radius": 0.6, "bsdf": bsdf}


def _scaled(factor: float) -> Any:
    import mitsuba as mi

    return mi.ScalarTransform3f().scale([factor, factor])


@register(name="tea", position=23)
@dataclass(frozen=True)
class Tea:
    """Extinction and albedo of the tea in a glass ball, in a room lit only by light bounced off its ceiling.

    One view. Two unknowns (3,). The scene multiplies the extinction by 10, to inverse units of length.
    """

    resolution: int = fields.resolution(32)
    reference_spp: int = fields.reference_spp(2048)
    max_depth: int = fields.max_depth(12, at_least=4)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the room of `indirect-room` without its photograph, with the ball before the back wall."""
        tea = {
            "type": "homogeneous",
            "scale": 10.0,  # Mitsuba limits colours to 1
            "sigma_t": parts.colour(0.25, 0.4, 0.7),
            "albedo": parts.colour(0.9, 0.72, 0.3),
            "sample_emitters": False,
        }
        room = parts.room(parts.diffuse(0.75), parts.diffuse(0.6, 0.08, 0.06), parts.diffuse(0.12, 0.42, 0.1))
        pot = {
            "type": "sphere",
            "center": [0.0, -0.5, 0.1],
            "radius": 0.5,
            "bsdf": {"type": "dielectric", "int_ior": 1.33},
        }
        return {
            "type": "scene",
            "camera": parts.camera((0, -0.1, 2.1), (0, -0.35, 0), 46.0, self.resolution),
            **room,
            "tea": pot | {"interior": tea},
            **parts.uplight((0.72, -0.999, 0.9), (40e3, 36e3, 30e3)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return both unknowns, initially thin and grey."""
        return (
            Parameter("tea.interior_medium.sigma_t.value.value", initial=0.15),
            Parameter("tea.interior_medium.albedo.value.value", initial=0.6),
        )
