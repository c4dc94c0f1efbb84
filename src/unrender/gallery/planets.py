"""Problems `two-planets`, `globe-and-mirror` and `three-textures`: painted bodies of adaptive pixel sampling (Figs 8, 9, 1 of its paper);
and `one-jar`, painted too, in four worlds.

`two-planets` is the exchange of two planets' textures. Light reaches the planet in the glass ball through two refractions, and no emitter
can be sampled from it: its pixels are much noisier than the other's, at equal derivatives. `globe-and-mirror` is the earth under glass,
with one large image: the mirror image of the globe's back needs a reflection in addition. In `three-textures`, outdoors, most pixels show
the ground, which contains almost no information about the paint. The sides in the sun are bright, the sky and the ground light the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from unrender.core.geometry import rotation
from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.gallery.specification import build_problem, reference
from unrender.preconditioners import LargeSteps
from unrender.rendering.mitsuba.scene_loading import load
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View

_PLANET, _INNER, _OUTER = 0.72, 0.92, 1.0  # radii of the planets and of the two sides of the glass
_APART = 1.05  # distance of each planet from the centre
_DUSK = ((0.06, 0.12, 0.32), (0.4, 0.42, 0.55), (0.1, 0.12, 0.22))  # radiance of zenith, horizon and nadir

_SUN = parts.unit([0.3, 0.75, 0.6])


@register(name="two-planets", position=11)
@dataclass(frozen=True)
class TwoPlanets(fields.Rendered):
    """The textures of two planets, one inside of glass, each initially with the other's texture.

    Many views. Two unknown reflectances of texture_resolution² texels, with LargeSteps. Paths to the enclosed planet and on to the light
    have at least 6 segments.
    """

    texture_resolution: int = fields.texture_resolution(32)
    views: int = fields.integer(16, "cameras around the planets, alternately lower and higher", at_least=1, at_most=32)
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(8, at_least=6)

    def scene(self) -> dict[str, Any]:
        """Return the planets: at x = -1.05 the free blue one, at x = 1.05 the enclosed red one, and the sky."""
        angles = 2 * np.pi * (np.arange(self.views) + 0.25) / self.views
        return {
            "type": "scene",
            **parts.cameras_around(angles, 6.2, (1.6, -0.5), (0, 0, 0), 41.0, self.resolution),
            "sky": sky(),
            "free": _ball("free", -_APART, blue(self.texture_resolution)),
            "enclosed": _ball("enclosed", _APART, red(self.texture_resolution)),
            "glass": shell(_OUTER, 1.5, 1.0, _APART),
            "hollow": shell(_INNER, 1.0, 1.5, _APART),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        smooth = LargeSteps(1.0)
        return (
            Parameter("free.bsdf.reflectance.data", initial=red(self.texture_resolution), preconditioner=smooth),
            Parameter("enclosed.bsdf.reflectance.data", initial=blue(self.texture_resolution), preconditioner=smooth),
        )


def _ball(name: str, x: float, texture: np.ndarray) -> Any:
    points = meshes.ellipsoid(_PLANET * np.eye(3), np.array([x, 0.0, 0.0]), 48, 96)
    return meshes.sheet(name, points, {"type": "diffuse", "reflectance": parts.bitmap(texture)}, closed=True)


def sky() -> dict[str, Any]:
    """Return a dusk sky with a large sun."""
    return parts.environment(parts.picture(_SUN, np.radians(18.0), (7.5, 7.0, 6.0), _DUSK))


def shell(radius: float, inside: float, outside: float, x: float = 0.0) -> dict[str, Any]:
    """Return one side of a glass ball around (x, 0, 0), with these indices of refraction."""
    return parts.sphere([x, 0.0, 0.0], radius, {"type": "dielectric", "int_ior": inside, "ext_ior": outside})


def blue(resolution: int) -> np.ndarray:
    """Return oceans, green to brown continents, polar ice and clouds: (resolution, resolution, 3) float32, v = 1 first."""
    x, land = _directions(resolution), _noise(resolution, 3, (1.6, 3.2, 6.0))
    cloud = parts.ramp(_noise(resolution, 8, (2.5, 5.0, 7.0)), 0.35, 1.0)
    deep, shelf, green, brown, ice = (
        np.array(c) for c in ([0.05, 0.1, 0.4], [0.08, 0.3, 0.5], [0.12, 0.35, 0.08], [0.5, 0.36, 0.18], [0.85] * 3)
    )
    sea = parts.mix(deep, shelf, parts.ramp(land, -0.5, 0.1))
    ground = parts.mix(green, brown, parts.ramp(land, 0.25, 0.9))
    surface = parts.mix(sea, ground, parts.ramp(land, 0.08, 0.2))
    surface = parts.mix(surface, ice, parts.ramp(np.abs(x[..., 1]) + 0.06 * land, 0.8, 0.88))
    return parts.mix(surface, np.array([0.85] * 3), 0.8 * cloud).astype(np.float32)


def red(resolution: int) -> np.ndarray:
    """Return rust with dark plains, craters and one white pole: (resolution, resolution, 3) float32, v = 1 first."""
    x, rough = _directions(resolution), _noise(resolution, 21, (2.0, 4.0, 8.0))
    dust, rust, dark, ice = (np.array(c) for c in ([0.75, 0.42, 0.2], [0.55, 0.2, 0.08], [0.2, 0.08, 0.06], [0.85] * 3))
    surface = parts.mix(rust, dust, parts.ramp(rough, -0.6, 0.8))
    surface = parts.mix(surface, dark, parts.ramp(_noise(resolution, 34, (1.5, 3.0)), 0.2, 0.7))
    rng = np.random.default_rng(55)
    for centre in rng.normal(size=(14, 3)):
        distance = np.arccos(np.clip(x @ parts.unit(centre), -1, 1)) / rng.uniform(0.12, 0.3)
        surface = parts.mix(surface, dust, 0.8 * np.exp(-(((distance - 1) / 0.25) ** 2)))
        surface = parts.mix(surface, dark, 0.7 * (1 - parts.ramp(distance, 0.6, 0.95)))
    return parts.mix(surface, ice, parts.ramp(x[..., 1] + 0.05 * rough, 0.82, 0.9)).astype(np.float32)


def _directions(resolution: int) -> np.ndarray:
    """Return each texel's position on the unit sphere, (resolution, resolution, 3), with the north pole's row first."""
    u, v = parts.grid(resolution)
    longitude, latitude = 2 * np.pi * (u - 0.5), np.pi * (0.5 - v)
    return np.stack(
        [np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)], axis=-1
    )


def _noise(resolution: int, seed: int, frequencies: tuple[float, ...]) -> np.ndarray:
    """Return seamless noise of waves with random directions through the sphere: (resolution, resolution), of variance about 1."""
    rng, x = np.random.default_rng(seed), _directions(resolution)
    total = np.zeros(x.shape[:2])
    for octave, frequency in enumerate(frequencies):
        for wave in rng.normal(size=(8, 3)):
            total += 0.7**octave * np.sin(x @ (frequency * wave) + rng.uniform(0, 2 * np.pi)) / 2
    return total / np.sqrt(sum(0.49**octave for octave in range(len(frequencies))))


_EYE, _MIRROR = np.array([1.4, 0.8, 6.0]), np.array([-2.1, 0.1, -1.5])
"""Positions of the camera and of the mirror's centre."""


@register(name="globe-and-mirror", position=32)
@dataclass(frozen=True)
class GlobeAndMirror(fields.Rendered):
    """The texture of a globe inside of glass, whose back is visible in a mirror, from one image.

    One view. An unknown reflectance of texture_resolution² texels, initially grey, with LargeSteps. A part of the back is not visible at
    all. Paths from the mirror to the globe and on to the light have 7 segments.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    reference_spp: int = fields.reference_spp(512)
    max_depth: int = fields.max_depth(9, at_least=7)

    def scene(self) -> dict[str, Any]:
        """Return the globe around the origin, with the mirror behind it at its left, oriented so that the camera sees the globe in its
        centre."""
        right, up = parts.facing(parts.unit(_EYE - _MIRROR) + parts.unit(-_MIRROR))
        globe = meshes.ellipsoid(_PLANET * np.eye(3), np.zeros(3), 48, 96)
        paint = {"type": "diffuse", "reflectance": parts.bitmap(blue(self.texture_resolution))}
        return {
            "type": "scene",
            "camera": parts.camera(_EYE, (-0.7, 0.0, -0.2), 34.0, self.resolution),
            "sky": sky(),
            "globe": meshes.sheet("globe", globe, paint, closed=True),
            "glass": shell(_OUTER, 1.5, 1.0),
            "hollow": shell(_INNER, 1.0, 1.5),
            "mirror": parts.rectangle(_MIRROR, 1.1 * right, 1.3 * up, {"type": "conductor", "material": "Ag"}),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("globe.bsdf.reflectance.data", initial=0.5, preconditioner=LargeSteps(1.0)),)


_NOON = parts.unit([0.45, 0.7, 0.55])  # direction to the sun
_FROM_CENTRE = 0.72  # distance of each object from the centre
_LAMPS = {"left": ([-2.0, 2.0, 2.0], (27.0, 24.0, 18.0)), "right": ([2.0, 1.5, 1.5], (18.0, 21.0, 27.0))}
"""Positions and intensities of the lamps of `one-jar`."""


@register(name="one-jar", position=36)
@dataclass(frozen=True)
class OneJar(fields.Rendered):
    """The paint of a jar and a lamp's intensity, from four pictures: under either lamp, turned around, and outdoors.

    Four views by one camera, each of a world of its own: the other lamp is off, the jar is turned by a known angle under both, or the scene
    is another one, with a sky. The unknowns are the reflectance, texture_resolution² texels, initially grey, with LargeSteps, and the
    intensity of the left lamp, (3,). Only the third picture shows the back of the jar. Those without the left lamp tell its intensity
    from the paint.
    """

    texture_resolution: int = fields.texture_resolution(32)
    reference_spp: int = fields.reference_spp(256)

    def scene(self) -> dict[str, Any]:
        """Return the jar on the y axis, its foot at y = 0, under both lamps."""
        return self._stage()

    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("jar.bsdf.reflectance.data", initial=0.5, preconditioner=LargeSteps(1.0)),
            Parameter("left.intensity.value", initial=12.0),
        )

    def problem(self, name: str) -> Problem:
        def view(seen: Any, **world: Any) -> View:
            return View(reference(load(seen), 0, self.reference_spp, self.max_depth), **world)

        alone = [
            view(partial(self._stage, dark=lamp), known={f"{lamp}.intensity.value": [0.0, 0.0, 0.0]}) for lamp in _LAMPS
        ]
        turned = view(partial(self._stage, turn=np.pi), known={"jar.rotation": [0.0, np.pi, 0.0]})
        outdoors = partial(self._stage, outdoors=True)
        return build_problem(name, self, [*alone, turned, view(outdoors, scene=outdoors)])

    def _stage(self, dark: str = "", turn: float = 0.0, outdoors: bool = False) -> dict[str, Any]:
        points = meshes.lathe(*_jar(32), 64) @ rotation((0, 1, 0), turn).T
        lamps = {
            name: {"type": "point", "position": place, "intensity": parts.colour(*(n * (name != dark) for n in colour))}
            for name, (place, colour) in _LAMPS.items()
        }
        return {
            "type": "scene",
            "camera": parts.camera((0, 1.0, 3.2), (0, 0.42, 0), 26.0, self.resolution),
            "ground": parts.rectangle((0, 0, 0), (9, 0, 0), (0, 0, -9), parts.diffuse(0.3)),
            "jar": _painted("jar", points, parts.bitmap(parts.photograph("chelsea", self.texture_resolution))),
            **(
                {"sky": parts.environment(parts.picture(_NOON, np.radians(8.0), (45.0, 40.0, 32.0)))}
                if outdoors
                else lamps
            ),
        }


@register(name="three-textures", position=31)
@dataclass(frozen=True)
class ThreeTextures(fields.Rendered):
    """The paint of three objects under a sky with a sun, seen from all sides.

    Several views. Three unknown reflectances of texture_resolution² texels, initially grey, with LargeSteps. No image shows the lower end
    of the ball.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    views: int = fields.integer(4, "cameras, at equal angles around the objects", at_least=1, at_most=32)
    reference_spp: int = fields.reference_spp(256)
    max_depth: int = fields.max_depth(4, at_least=2)

    def scene(self) -> dict[str, Any]:
        """Return the objects on the ground y = 0, each at 0.72 from the y axis, the ball at +z."""
        angles = 0.5 + 2 * np.pi * np.arange(self.views) / self.views
        rows, columns = 48, 96
        ball = meshes.ellipsoid(0.45 * np.eye(3), np.array([0.0, 0.45, 0.0]), rows, columns)
        jar, cone = meshes.lathe(*_jar(rows), columns), meshes.lathe(*_cone(rows), columns)
        planet = parts.bitmap(blue(self.texture_resolution))
        return {
            "type": "scene",
            **parts.cameras_around(angles, 4.4, (2.2,), (0, 0.4, 0), 32.0, self.resolution),
            "sky": parts.environment(parts.picture(_NOON, np.radians(8.0), (45.0, 40.0, 32.0))),
            "ground": parts.rectangle((0, 0, 0), (30, 0, 0), (0, 0, -30), parts.diffuse(0.3, 0.27, 0.22)),
            "ball": _painted("ball", ball + _place(0), planet),
            "jar": _painted("jar", jar + _place(1), self._photograph("chelsea")),
            "cone": _painted("cone", cone + _place(2), self._photograph("coffee")),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        smooth = LargeSteps(1.0)
        return tuple(
            Parameter(f"{name}.bsdf.reflectance.data", initial=0.5, preconditioner=smooth)
            for name in ("ball", "jar", "cone")
        )

    def _photograph(self, name: parts.Photograph) -> dict[str, Any]:
        """Return an upright photograph, once on either half of the circumference, mirrored."""
        return parts.bitmap(parts.photograph(name, self.texture_resolution)[::-1], repeat=(2, 1))


def _painted(name: str, points: np.ndarray, texture: dict[str, Any]) -> Any:
    return meshes.sheet(name, points, {"type": "diffuse", "reflectance": texture}, closed=True)


def _place(number: int) -> np.ndarray:
    angle = 2 * np.pi * number / 3
    return np.array([_FROM_CENTRE * np.sin(angle), 0.0, _FROM_CENTRE * np.cos(angle)])


def _jar(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radius and height of a drum with round edges, closed at the top and bottom."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, rows)
    return 0.42 * np.cos(angle) ** 0.5 + 1e-3, 0.45 + 0.45 * np.sin(angle)


def _cone(rows: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0, 1, rows)
    return 0.46 * (1 - t) + 1e-3, 1.05 * t
