"""Problems `smoke`, `nerf-volume`, `three-bodies` and `tea`, and parts of problems with media: grids, cameras, a cube with invisible faces.

`smoke` is after Nicolet et al. 2023, Figs 5 and 11. Most of the cube is empty, and some of it dense, with multiple scattering. In a voxel
that the optimisation has emptied, collisions alone would never show that smoke is missing. `nerf-volume`, an object with surfaces, is
fitted by a volume that emits and absorbs. After Balint et al. 2023, Figs 7 and 8; `balls` has small balls far from each other, as Fig. 8.
`three-bodies` and `tea` are after Nicolet et al. 2023, Fig. 2 and section 6. The tea is in a glass ball, in a room that is lit only via its
ceiling. Glass refracts every ray, so no emitter can be sampled from inside of the tea: with few samples the image is noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, parts
from unrender.gallery.specification import reconstruction
from unrender.losses import L1, Loss
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem


def grid(values: np.ndarray) -> dict[str, Any]:
    """Return a volume over the cube [-1, 1]³, interpolated linearly between voxel centres.

    Args:
        values: (Z, Y, X, C), stored unchanged.
    """
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    volume = mi.VolumeGrid(np.ascontiguousarray(values, dtype=np.float32))
    return {"type": "gridvolume", "grid": volume, "raw": True, "to_world": place}


def cube(medium: dict[str, Any]) -> dict[str, Any]:
    """Return the cube [-1, 1]³ filled with a medium; its faces do not refract."""
    return {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}


def around(views: int, resolution: int, distance: float = 4.2, fov: float = 36.0) -> dict[str, Any]:
    """Return cameras at equal angles around the y axis, alternately lower and higher, that look at the origin; `fov` is in degrees."""
    angles = np.pi / 6 + 2 * np.pi * np.arange(views) / views
    heights = np.where(np.arange(views) % 2 == 0, 0.25, 0.6)
    return {
        f"camera_{number}": parts.camera(
            distance * np.array([np.sin(a) * np.cos(h), np.sin(h), np.cos(a) * np.cos(h)]), (0, 0, 0), fov, resolution
        )
        for number, (a, h) in enumerate(zip(angles, heights, strict=True))
    }


def positions(resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y and z of the voxel centres of `grid`, each (resolution, resolution, resolution)."""
    middle = (np.arange(resolution) + 0.5) / resolution * 2 - 1
    z, y, x = np.meshgrid(middle, middle, middle, indexing="ij")
    return x, y, z


def noise(resolution: int, octaves: int, seed: int) -> np.ndarray:
    """Return smooth noise of octaves in [0, 1], each of half the amplitude at twice the frequency: (resolution,) * 3, alike at any
    resolution."""
    from scipy.ndimage import map_coordinates

    rng = np.random.default_rng(seed)
    x, y, z = positions(resolution)
    total = np.zeros_like(x)
    for octave in range(octaves):
        cells = 3 * 2**octave
        values = rng.uniform(0, 1, (cells + 1,) * 3)
        place = [(c + 1) / 2 * cells for c in (z, y, x)]
        total += map_coordinates(values, place, order=1) * 0.5**octave
    return total / (2 - 0.5 ** (octaves - 1))


@register(name="smoke", position=24)
@dataclass(frozen=True)
class Smoke(fields.Rendered):
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
            "sigma_t": grid(density),
            "albedo": grid(colour),
            "phase": {"type": "isotropic"},
        }
        return {
            "type": "scene",
            **around(self.views, self.resolution, fov=30.0),
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(_sky()), "to_world": mi.ScalarTransform4f()},
            "smoke": cube(medium),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return both grids; extinction has the wider range, and larger steps."""
        return (
            Parameter("smoke.interior_medium.sigma_t.data", initial=0.4, learning_rate=0.1),
            Parameter("smoke.interior_medium.albedo.data", initial=0.6),
        )


def _smoke(resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Return extinction (Z, Y, X, 1), from 0 to about 6, and albedo (Z, Y, X, 3): a rising and spreading plume, ochre below, blue above."""
    x, y, z = positions(resolution)
    lean = 0.25 * np.sin(2 * y)
    radius = np.hypot(x - lean, z) / (0.55 + 0.25 * y)
    plume = parts.ramp(1.1 - radius, 0, 0.5) * parts.ramp(0.95 - np.abs(y), 0, 0.3)
    billows = parts.ramp(noise(resolution, 4, seed=1), 0.35, 0.75)
    density = 6 * plume * billows
    mix = parts.ramp(y + 0.6 * (noise(resolution, 2, seed=2) - 0.5), -0.6, 0.6)[..., None]
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


@register(name="nerf-volume", position=25)
@dataclass(frozen=True)
class NerfVolume(fields.Rendered):
    """A toy of coloured balls and blocks, seen from all sides, fitted by a volume that emits and absorbs.

    Several views. The unknowns are extinction (grid_resolution³, 1) and emitted radiance (grid_resolution³, 3), initially a thin grey
    glow. There is no true value: the toy has surfaces, and its appearance depends on the direction.
    """

    resolution: int = fields.resolution(32)
    grid_resolution: int = fields.integer(16, "voxels along a side of each unknown grid", at_least=2)
    views: int = fields.integer(16, "cameras, at equal angles around the toy", at_least=1, at_most=64)
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(4, at_least=2)
    balls: int = fields.integer(
        0, "number of small coloured balls in place of the toy, a sparse volume; 0 for the toy", 0, 512
    )

    def scene(self) -> dict[str, Any]:
        """Return the initial volume in the cube [-1, 1]³."""
        size = (self.grid_resolution,) * 3
        density, glow = grid(np.full((*size, 1), 0.5)), grid(np.full((*size, 3), 0.4))
        return self._stage() | {"volume": cube({"type": "emissive", "sigma_t": density, "emission": glow})}

    def target(self) -> dict[str, Any]:
        """Return the toy, or the balls, in place of the volume, in the sun."""
        return self._stage() | (_balls(self.balls) if self.balls else _toy()) | {"sun": parts.sun((0.5, 0.8, 0.4), 0.9)}

    def parameters(self) -> tuple[Parameter, ...]:
        """Return both grids; extinction has the wider range, and larger steps."""
        return (
            Parameter("volume.interior_medium.sigma_t.data", learning_rate=0.2),
            Parameter("volume.interior_medium.emission.data"),
        )

    def problem(self, name: str) -> Problem:
        """Return the problem: the volume's scene, with direct emission only, and references of the toy by Mitsuba's `path` integrator."""
        return reconstruction(name, self, max_depth=1)

    def _stage(self) -> dict[str, Any]:
        sky = {"type": "constant", "radiance": parts.colour(0.3, 0.35, 0.4)}
        return {"type": "scene", **around(self.views, self.resolution), "sky": sky}


def _toy() -> dict[str, Any]:
    to = mi.ScalarTransform4f()
    red, blue, gold, green = ([0.75, 0.15, 0.1], [0.1, 0.25, 0.7], [0.8, 0.6, 0.15], [0.15, 0.55, 0.2])
    return {
        "base": {"type": "cube", "to_world": to.translate([0, -0.55, 0]).scale([0.6, 0.12, 0.6]), "bsdf": parts.diffuse(*blue)},
        "body": parts.sphere([0.0, -0.1, 0.0], 0.36, parts.diffuse(*red)),
        "head": parts.sphere([0.1, 0.4, 0.05], 0.22, parts.diffuse(*gold)),
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
        f"ball_{n}": parts.sphere(center, radius, parts.diffuse(*colour))
        for n, (center, colour) in enumerate(zip(centers, colours.tolist(), strict=True))
    }


@register(name="three-bodies", position=22)
@dataclass(frozen=True)
class ThreeBodies(fields.Rendered):
    """Albedo, roughness and extinction of three balls: of paint, of metal and of fog.

    One view. The unknowns are a reflectance (3,), a roughness α () and an extinction (3,). The scene multiplies the extinction by 4, to
    inverse units of length.
    """

    max_depth: int = fields.max_depth(6, at_least=2)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return three balls of radius 0.6 on the floor y = -0.6, under a lamp and a sky."""
        tiles = {"type": "checkerboard", "color0": parts.colour(0.15), "color1": parts.colour(0.6)}
        tiles["to_uv"] = mi.ScalarTransform3f().scale([24.0, 24.0])
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
    return parts.sphere([x, 0.0, 0.0], 0.6, bsdf)


@register(name="tea", position=23)
@dataclass(frozen=True)
class Tea(fields.Rendered):
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
        pot = parts.sphere([0.0, -0.5, 0.1], 0.5, {"type": "dielectric", "int_ior": 1.33})
        return {
            "type": "scene",
            "camera": parts.camera((0, -0.1, 2.1), (0, -0.35, 0), 46.0, self.resolution),
            **room,
            "tea": pot | {"interior": tea},
            **parts.uplight((0.72, -0.999, 0.9), (40e3, 36e3, 30e3)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("tea.interior_medium.sigma_t.value.value", initial=0.15),
            Parameter("tea.interior_medium.albedo.value.value", initial=0.6),
        )
