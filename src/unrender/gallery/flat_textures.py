"""Problems `poster`, `noisy-tiles`, `two-posters` and `caustic`: a flat texture in direct light, with a prior too, a pattern of two
posters, and the tiles of a floor in caustics.

`poster`, TEXTURE of Wang et al., section 4, shows how derivatives from perturbed renders scale with the dimension, and why an n × n matrix
must not be formed. Path gradients, whose cost does not depend on the number of texels, solve it easily.

At `caustic`, two lamps inside of glass balls, adaptive pixel sampling fails (Fig. 7 of its paper). The glass blocks emitter samples. A path
hits a lamp rarely, and is bright when it does, so a few samples per pixel contain almost no information about large or noisy gradients.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.gallery.specification import build_problem, views_of
from unrender.preconditioners import LargeSteps
from unrender.rendering.mitsuba.scene_loading import load
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem

_RADIUS, _HEIGHT = 0.34, 0.85  # radius of the balls of `caustic`, and height of their centres above the floor

_LAMPS = {"left": (-0.58, -0.15, (1.0, 0.85, 0.65)), "right": (0.58, 0.05, (0.75, 0.9, 1.0))}
"""x and z of their centres, and tint."""

_COLOURS = np.array([[0.75, 0.7, 0.6], [0.12, 0.35, 0.6], [0.7, 0.38, 0.15], [0.15, 0.5, 0.4]])
_SHADES = (1.1, 0.75)
"""Colours of the tiles, and factors of light and dark ones."""

_MIXED = {"left": ((0.1, 0.1, 0.25), (0.9, 0.8, 0.6)), "right": ((0.7, 0.2, 0.1), (0.2, 0.5, 0.8))}
"""Colours of the posters of `two-posters` where the pattern is 0 and 1."""
_BOARDS, _SHARES = np.array([0.7, 0.5, 0.3]), {"left": 1.0, "right": 0.5}
"""Paint of its boards, and the factor of each."""

_PRIORS = ("total_variation", "palette", "none")


@register(name="poster", position=20)
@dataclass(frozen=True)
class Poster(fields.Rendered):
    """The grey texture of a poster in direct light.

    One view. One unknown, the reflectance (texture_resolution², 1), initially constant: 1024 numbers by default. The loss is a convex
    quadratic, smooth and without a plateau. The number of unknowns is the difficulty for derivatives from perturbations. Texels are not
    interpolated. If each pixel shows one texel, the Hessian is diagonal.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)

    def scene(self) -> dict[str, Any]:
        """Return the poster, x and y in [-1, 1] at z = 0, filling the image, with the lamp before it, above the field of view."""
        # Texels are squares. With interpolation, no image would distinguish the finest pattern from its mean grey.
        texels = parts.bitmap(self.texture()) | {"filter_type": "nearest"}
        paint = {"type": "diffuse", "reflectance": texels}
        down = np.array([0.0, -0.6, -0.8])
        return {
            "type": "scene",
            "camera": parts.camera((0, 0, 4), (0, 0, 0), 2 * np.degrees(np.arctan(0.25)), self.resolution),
            "poster": parts.rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0), paint),
            "lamp": parts.rectangle(
                (0, 1.8, 2.4),
                (0.5, 0, 0),
                0.3 * np.cross(down, [1.0, 0, 0]),
                parts.diffuse(0.0),
                emitter=parts.light(32.0, 32.0, 32.0),
            ),
        }

    def texture(self) -> np.ndarray:
        return parts.photograph("astronaut", self.texture_resolution).mean(axis=2, keepdims=True).astype(np.float32)

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("poster.bsdf.reflectance.data", initial=0.5),)


@register(name="noisy-tiles", position=37)
@dataclass(frozen=True)
class NoisyTiles(Poster):
    """A mosaic of few colours from one noisy image, with a prior of its texture.

    One view. One unknown, the reflectance (texture_resolution², 3), initially constant. The image has the noise of few photons, which
    without a prior stays in the texture. The prior, in units of that noise, is a total variation, or a palette of the tiles' colours.
    """

    photons: int = fields.integer(200, "mean number of photons in a channel of radiance 1", at_least=1)
    prior: str = fields.choice("total_variation", f"prior of the texture: {', '.join(_PRIORS)}", _PRIORS)

    def texture(self) -> np.ndarray:
        return _mosaic(self.texture_resolution)

    def parameters(self) -> tuple[Parameter, ...]:
        options: dict[str, dict[str, Any] | None] = {
            "total_variation": {"total_variation": 0.05},
            "palette": {"palette": np.concatenate([_COLOURS * shade for shade in _SHADES]), "std": 0.05},
        }
        return (Parameter("poster.bsdf.reflectance.data", initial=0.5, prior=options.get(self.prior)),)

    def problem(self, name: str) -> Problem:
        (view,) = views_of(load(self.scene), self)
        counted = np.random.default_rng(0).poisson(self.photons * np.asarray(view.reference))
        return build_problem(name, self, [replace(view, reference=(counted / self.photons).astype(np.float32))])


@register(name="two-posters", position=38)
@dataclass(frozen=True)
class TwoPosters(Poster):
    """The pattern that two posters of different colours share, and the paint of both boards behind them.

    One view. The pattern (texture_resolution², 1) is an unknown of two expressions, one per poster: each mixes two known colours by it. The
    paint of the boards is one unknown for both, and half as bright on the right.
    """

    def scene(self) -> dict[str, Any]:
        """Return both posters, before boards, with the pattern and the paint at their true values."""
        pattern, stage = self.texture(), super().scene()
        del stage["poster"]
        for (name, share), x in zip(_SHARES.items(), (-0.52, 0.52), strict=True):
            one, other = np.array(_MIXED[name])
            texels = parts.bitmap(one + pattern * (other - one)) | {"filter_type": "nearest"}
            paint = {"type": "diffuse", "reflectance": texels}
            stage[name] = parts.rectangle((x, 0, 0), (0.42, 0, 0), (0, 0.42, 0), paint)
            board = parts.diffuse(*(share * _BOARDS))
            stage[f"{name}_board"] = parts.rectangle((x, 0, -0.01), (0.48, 0, 0), (0, 0.6, 0), board)
        return stage

    def parameters(self) -> tuple[Parameter, ...]:
        boards = {f"{name}_board.bsdf.reflectance.value": share for name, share in _SHARES.items()}
        pattern = np.full((self.texture_resolution, self.texture_resolution, 1), 0.5)
        return Parameter("pattern", initial=pattern, bounds=(0.0, 1.0)), Parameter("boards", initial=0.5, keys=boards)

    def problem(self, name: str) -> Problem:
        texts = {
            f"{name}.bsdf.reflectance.data": f"mix({list(one)}, {list(other)}, pattern)"
            for name, (one, other) in _MIXED.items()
        }
        views, truth = views_of(load(self.scene), self), {"pattern": self.texture(), "boards": _BOARDS}
        return Problem(
            self.scene, self.parameters(), views, self.loss, self.max_depth, expressions=texts, truth=truth, name=name
        )


@register(name="caustic", position=12)
@dataclass(frozen=True)
class Caustic(fields.Rendered):
    """The texture of a floor that two lamps light through glass balls, in caustics.

    One view. One unknown reflectance (texture_resolution², 3), initially grey, with LargeSteps. Only paths of at least 4 segments reach
    the lamps, and few of them do; a panel that can be sampled lights the floor a little. So the gradient depends on rare samples, and
    fewer samples per pixel and step require smaller steps.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(32)
    max_depth: int = fields.max_depth(5, at_least=4)

    def scene(self) -> dict[str, Any]:
        """Return the floor: x in [-1.3, 1.3], z in [-0.9, 0.9] at y = 0.

        The lamps' tubes extend upwards from the balls' equators, out of view.
        """
        tiles = {"type": "diffuse", "reflectance": parts.bitmap(_mosaic(self.texture_resolution))}
        return {
            "type": "scene",
            "camera": parts.camera((0, 1.8, 2.5), (0, 0.3, 0.0), 46.0, self.resolution),
            "floor": parts.rectangle((0, 0, 0), (1.3, 0, 0), (0, 0, -0.9), tiles),
            "around": parts.rectangle((0, -0.01, 0), (9, 0, 0), (0, 0, -9), parts.diffuse(0.15)),
            "panel": parts.rectangle(
                (0, 3.0, 1.5), (0.6, 0, 0), (0, 0, 0.6), parts.diffuse(0.0), emitter=parts.light(7.0, 8.0, 9.5)
            ),
            **{
                f"{name}_{part}": piece
                for name, (x, z, tint) in _LAMPS.items()
                for part, piece in _lamp(np.array([x, _HEIGHT, z]), tint).items()
            },
        }

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("floor.bsdf.reflectance.data", initial=0.4, preconditioner=LargeSteps(1.0)),)


def _lamp(middle: np.ndarray, tint: tuple[float, float, float]) -> dict[str, Any]:
    """Return a disc light in a black tube that a glass ball closes: all its light passes through the glass."""
    tube, length, disc = 1.01 * _RADIUS, 0.6, 0.3
    points = meshes.lathe(np.full(2, tube), np.array([0, length]), 48) + middle
    down = mi.ScalarTransform4f().translate((middle + [0, length, 0]).tolist()).rotate([1, 0, 0], 90)
    return {
        "ball": parts.sphere(middle, _RADIUS, {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}),
        "tube": meshes.sheet("tube", points, parts.twosided(parts.diffuse(0.05)), closed=True),
        "lid": {
            "type": "disk",
            "to_world": down @ mi.ScalarTransform4f().translate([0, 0, -0.01]).scale(tube),
            "bsdf": parts.diffuse(0.0),
        },
        "light": {
            "type": "disk",
            "to_world": down.scale(disc),
            "bsdf": parts.diffuse(0.0),
            "emitter": parts.light(*(11.0 * value for value in tint)),
        },
    }


def _mosaic(resolution: int) -> np.ndarray:
    u, v = parts.grid(resolution)
    x, y = np.floor(8 * u) - 3.5, np.floor(8 * v) - 3.5
    tile = _COLOURS[(np.maximum(np.abs(x), np.abs(y)) + 2 * (np.abs(x) == np.abs(y))).astype(int) % 4]
    return (tile * np.where((x + y) % 2 == 0, *_SHADES)[..., None]).astype(np.float32)
