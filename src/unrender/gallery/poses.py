"""Problems `shadow`, `bunny`, `mug`, `box2` and `box10`: poses of bodies and of flat squares. After Wang et al., section 4.

`shadow` is the position of a floating ball outside of the image, from its shadow on the floor. A shadow caster gets no path gradient from
its shadow, because visibility is discontinuous. Where the shadow does not overlap its true position, even the true loss is flat. `bunny`
is the task without a plateau, which gradients of the unsmoothed loss can solve as well. In `mug`, all but the handle is a surface of
revolution, so a rotation does not change the image while the handle is hidden. With an unknown label, the pose needs perturbed renders and
the texture needs path gradients: see `estimators/hybrid.py`. `box2` and `box10` are the plateau task of Fischer and Ritschel 2023. Small
motions of a square that does not overlap its true position do not change the loss. Only larger motions show the direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.geometry import rotation
from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.scene.parameter import Parameter

_SUN = np.array([0.4, 1.0, -0.25])
_HEIGHT = 4.0
_RADIUS = 0.32
_TRUTH, _START = (0.4, -0.3), (-0.45, 0.35)  # true centre of the shadow: x and z
_REACH = 0.6  # largest distance of the shadow from the centre of the image, in x and in z


@register(name="shadow", position=18)
@dataclass(frozen=True)
class Shadow(fields.Rendered):
    """The position of a ball outside of the image: two numbers, from its shadow, initially away from the true one.

    One view. The unknowns are x and z of the ball's translation, bounded so that its shadow is in the image. A plateau: the loss does not
    change until the shadows overlap. The renderer's path gradient is zero everywhere.
    """

    def scene(self) -> dict[str, Any]:
        """Return the floor y = 0, with the camera below the ball, looking straight down, so that the shadow's shape does not change."""
        above = (0, 3.2, 0)
        x, z = np.array(_TRUTH) + _HEIGHT * _SUN[[0, 2]] / _SUN[1]
        return {
            "type": "scene",
            "camera": parts.camera(above, (0, 0, 0), 35.0, self.resolution)
            | {"to_world": mi.ScalarTransform4f().look_at(list(above), [0, 0, 0], [0, 0, -1])},
            "sun": parts.sun(_SUN, 1.2),
            "floor": parts.rectangle((0, 0, 0), (6, 0, 0), (0, 0, -6), parts.diffuse(0.6, 0.5, 0.35)),
            "ball": parts.sphere((x, _HEIGHT, z), _RADIUS, parts.diffuse(0.5)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the ball's position above the floor, relative to the truth."""
        unknowns: list[Parameter] = []
        for axis, truth, start in zip("xz", _TRUTH, _START, strict=True):
            unknowns += parts.unknown_pose(
                "ball", "translation", {axis: start - truth}, (-_REACH - truth, _REACH - truth)
            )
        return tuple(unknowns)


@register(name="bunny", position=19)
@dataclass(frozen=True)
class Bunny(fields.Rendered):
    """The position and direction of an animal: three numbers; the start overlaps the reference.

    One view. The unknowns are x and z of its translation, and its rotation about the vertical. There is no plateau: it starts a fraction
    of its size away, rotated by 30 degrees. The difficulty is that the three are correlated in the silhouette. The animal is made by
    code, or read from a file.
    """

    mesh: str = meshes.option("PLY or OBJ file of an animal, y upwards, in place of the one made by code")
    detail: int = fields.integer(1, "d: the mesh made by code has about 3600 d^2 vertices", at_least=1, at_most=16)

    def scene(self) -> dict[str, Any]:
        """Return the animal, 1 along its longest side, on the floor y = 0 at the origin, with the sun at the camera's left."""
        fur = parts.twosided(parts.diffuse(0.75, 0.6, 0.45))
        made = meshes.standing(self.mesh, fur) if self.mesh else meshes.sheets("bunny", _animal(self.detail), fur)
        return {
            "type": "scene",
            "camera": parts.camera((0.1, 2.0, 3.0), (0.1, 0.33, 0), 30.0, self.resolution),
            "sun": parts.sun((-0.6, 1.0, 0.7), 1.2),
            "floor": parts.rectangle((0, 0, 0), (6, 0, 0), (0, 0, -6), parts.diffuse(0.25, 0.4, 0.25)),
            "bunny": made,
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return position and direction relative to the truth."""
        return (
            *parts.unknown_pose("bunny", "translation", {"x": -0.22, "z": 0.25}, bounds=(-0.6, 0.6)),
            *parts.unknown_pose("bunny", "rotation", {"y": np.radians(30.0)}),
        )


def _animal(detail: int) -> list[meshes.Sheet]:
    """Return a sitting hare that looks along +x and slightly to the camera: body, haunch, chest, head, muzzle, two ears, a tail."""
    turn = rotation((0, 1, 0), np.radians(-35))  # from +x towards the camera

    def ball(centre: tuple[float, float, float], radii: tuple[float, float, float], tilt: float = 0.0) -> meshes.Sheet:
        axes = meshes.Ellipsoid(centre, radii, tilt).axes
        return meshes.Sheet(meshes.ellipsoid(axes, np.array(centre), 16 * detail, 24 * detail) @ turn.T)

    return [
        ball((-0.05, 0.27, 0), (0.36, 0.25, 0.23), 12),
        ball((-0.2, 0.2, 0.12), (0.2, 0.2, 0.13)),
        ball((-0.2, 0.2, -0.12), (0.2, 0.2, 0.13)),
        ball((0.2, 0.2, 0), (0.12, 0.2, 0.14)),
        ball((0.3, 0.53, 0), (0.17, 0.15, 0.14), -15),
        ball((0.43, 0.49, 0), (0.08, 0.07, 0.08)),
        ball((0.2, 0.8, 0.08), (0.06, 0.22, 0.04), 18),
        ball((0.2, 0.8, -0.08), (0.06, 0.22, 0.04), 18),
        ball((-0.42, 0.28, 0), (0.08, 0.08, 0.08)),
    ]


_SIDE = np.radians(105.0)  # true angle of the mug's handle: 0 faces the camera, a right angle is to the camera's right
_HIDDEN = np.radians(158.0)  # initial angle of the handle

_LABEL_WIDTH, _LABEL_HEIGHTS = np.radians(100.0), (0.24, 0.86)
"""Angle that the label covers, and its lower and upper height."""

_LABEL = "mug.bsdf.brdf_0.bsdf_1.reflectance.data"

_CUP, _ELSEWHERE = (0.0, 0.0), (0.0, 2.0)  # origins of texture coordinates: of the cup, and of parts without a label


@register(name="mug", position=17)
@dataclass(frozen=True)
class Mug(fields.Rendered):
    """The rotation of a cup: one angle, with the handle initially hidden behind it.

    One view. The unknown is the rotation about the vertical and, with `label`, also a texture (label², 3) on the cup's front, initially
    grey. A plateau with a barrier: the image does not change until the handle appears from behind the cup. Then the loss increases: on
    the wrong side permanently, on the right side for about 15 degrees, until the handle overlaps its true position. A smoothing of about
    25 degrees or more (σ) overcomes both.
    """

    label: int = fields.integer(0, "texels along a side of an unknown label on the cup, 0 for no label", at_least=0)

    def scene(self) -> dict[str, Any]:
        """Return the cup, 1 high, on a table y = 0 around the y axis, with the camera and the higher sun in front of it."""
        pieces, glaze = _pieces(), parts.diffuse(0.75, 0.3, 0.15)
        if self.label:
            glaze = _labelled(glaze, pieces[0].positions, self.label)
        turned = [meshes.Sheet(piece.positions @ rotation((0, 1, 0), _SIDE).T, origin=piece.origin) for piece in pieces]
        return {
            "type": "scene",
            "camera": parts.camera((0, 1.5, 3.6), (0, 0.42, 0), 30.0, self.resolution),
            "sun": parts.sun((0, 0.5, 1), 1.0),
            "table": parts.rectangle((0, 0, 0), (6, 0, 0), (0, 0, -4), parts.diffuse(0.3, 0.35, 0.4)),
            "wall": parts.rectangle((0, 2, -4), (6, 0, 0), (0, 2, 0), parts.diffuse(0.5, 0.5, 0.45)),
            "mug": meshes.sheets("mug", turned, parts.twosided(glaze)),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the angle relative to the truth, and the label, initially grey."""
        angle = parts.unknown_pose("mug", "rotation", {"y": _HIDDEN - _SIDE})
        return (*angle, Parameter(_LABEL, initial=0.4)) if self.label else tuple(angle)


def _labelled(glaze: dict[str, Any], cup: np.ndarray, texels: int) -> dict[str, Any]:
    """Return the glaze with a label of `texels` a side, which faces the camera in the true scene, on the cup from `_pieces()`."""
    outside = np.arange(len(cup)) <= np.argmax(cup[:, 0, 1])
    rows = np.flatnonzero(outside & (cup[:, 0, 1] >= _LABEL_HEIGHTS[0]) & (cup[:, 0, 1] <= _LABEL_HEIGHTS[1]))
    bottom, top = rows[[0, -1]] / (len(cup) - 1)
    width = _LABEL_WIDTH / (2 * np.pi)
    left = 0.5 - _SIDE / (2 * np.pi) - width / 2  # u = 0.5 is at the handle
    to = mi.ScalarTransform4f
    inside = to().scale([1 / width, 1 / (top - bottom), 1]) @ to().translate([-left, -bottom, 0])
    upright = to().translate([0, 1, 0]) @ to().scale([1, -1, 1])
    picture = parts.bitmap(parts.photograph("coffee", texels)) | {"to_uv": upright @ inside}
    ninth = to().translate([1 / 3, 1 / 3, 0]) @ to().scale([1 / 3, 1 / 3, 1])
    middle = np.zeros((3, 3), np.float32)
    middle[1, 1] = 1.0
    weight = parts.bitmap(middle) | {"filter_type": "nearest", "to_uv": ninth @ inside}
    return {"type": "blendbsdf", "weight": weight, "glaze": glaze, "label": {"type": "diffuse", "reflectance": picture}}


def _pieces() -> list[meshes.Sheet]:
    """Return cup, handle (towards +z) and saucer.

    The saucer extends farther than the handle, so that the centre of the mesh's bounding box, about which poses rotate, is on the axis.
    """
    cup = [(0, 0.03), (0.2, 0.03), (0.3, 0.04), (0.34, 0.12), (0.4, 0.5), (0.44, 0.98), (0.425, 1), (0.41, 0.98)]
    cup += [(0.37, 0.5), (0.31, 0.15), (0.25, 0.1), (0, 0.1)]
    saucer = [(0, 0.005), (0.5, 0.005), (0.88, 0.075), (0.9, 0.09), (0.87, 0.09), (0.5, 0.03), (0, 0.03)]
    bend = np.linspace(np.radians(118), np.radians(-118), 24)
    path = np.stack([0.45 + 0.33 * np.cos(bend), 0.55 + 0.27 * np.sin(bend), 0 * bend], -1)
    handle = meshes.sweep(path, 0.09, 16) @ rotation((0, 1, 0), -np.pi / 2).T
    return [
        meshes.Sheet(_lathe(cup, 40), origin=_CUP),
        meshes.Sheet(handle, origin=_ELSEWHERE),
        meshes.Sheet(_lathe(saucer, 30), origin=_ELSEWHERE),
    ]


def _lathe(knots: list[tuple[float, float]], rows: int) -> np.ndarray:
    """Return a polyline profile, evenly sampled, as a surface of revolution."""
    corners = np.array(knots)
    corners[:, 0] = np.maximum(corners[:, 0], 1e-3)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    where = np.union1d(length, np.linspace(0, length[-1], rows))
    return meshes.lathe(np.interp(where, length, corners[:, 0]), np.interp(where, length, corners[:, 1]), 96)


_GREY = 0.4  # colour of the wall behind the squares
_CELL = 0.45  # their positions are cells of a 4 by 4 grid
_FAR = 10.0  # position of the camera, so distant that squares at different depths have equal size and show no shadow


@dataclass(frozen=True)
class _Square:
    """A square: its colour, and its true and initial position, (column, row) in cells from the middle of the image."""

    colour: tuple[float, float, float]
    truth: tuple[float, float]
    start: tuple[float, float]


# The squares' contrasts to the wall are axes of RGB space, of either sign. So a square does not reduce the loss at the position of
# another square: only its own position attracts it.
_FIVE = (
    _Square((0.8, _GREY, _GREY), (-1.5, 0.5), (-0.5, 1.5)),
    _Square((0.0, _GREY, _GREY), (0.5, 1.5), (1.5, 0.5)),
    _Square((_GREY, 0.8, _GREY), (-0.5, -0.5), (0.5, 0.5)),
    _Square((_GREY, 0.0, _GREY), (1.5, -1.5), (0.5, -0.5)),
    _Square((_GREY, _GREY, 0.8), (-1.5, -1.5), (-0.5, -1.4)),
)
_ONE = (_Square((0.85, 0.5, 0.1), (0.7, 0.6), (-0.9, -0.7)),)


@register(name="box2", position=15)
@dataclass(frozen=True)
class Box2(fields.Rendered):
    """The position of a square: two numbers, initially without overlap with the true position.

    One view. The unknowns are x and y of the square's translation, bounded to the image. A plateau: until the square overlaps its true
    position, the loss changes only at pixels that the square's edges share.
    """

    def scene(self) -> dict[str, Any]:
        return _scene(_ONE, 0.2, self.resolution)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the square's position, initially on the other side of the image."""
        return _parameters(_ONE, 0.2)


@register(name="box10", position=16)
@dataclass(frozen=True)
class Box10(fields.Rendered):
    """The positions of five squares: ten numbers, initially without overlap with the true positions.

    One view. The unknowns are x and y of each square's translation, bounded to the image. Every coordinate has a plateau, and squares can
    occlude each other.
    """

    def scene(self) -> dict[str, Any]:
        return _scene(_FIVE, 0.18, self.resolution)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the squares' positions, initially at cells that no square of the reference occupies."""
        return _parameters(_FIVE, 0.18)


def _scene(squares: tuple[_Square, ...], half: float, resolution: int) -> dict[str, Any]:
    """Return a grey wall z = 0, visible for x and y in [-1, 1], lit from the camera's direction, so that the image shows the colours."""
    return {
        "type": "scene",
        "camera": parts.camera((0, 0, _FAR), (0, 0, 0), 2 * np.degrees(np.arctan(1 / _FAR)), resolution),
        "sun": parts.sun((0, 0, 1), 1.0),
        "wall": parts.rectangle((0, 0, 0), (1.5, 0, 0), (0, 1.5, 0), parts.diffuse(_GREY)),
        **{
            f"box_{number}": parts.rectangle(
                (*_place(square.truth), 0.004 * (number + 1)), (half, 0, 0), (0, half, 0), parts.diffuse(*square.colour)
            )
            for number, square in enumerate(squares)
        },
    }


def _parameters(squares: tuple[_Square, ...], half: float) -> tuple[Parameter, ...]:
    reach = 0.98 - half
    unknowns = []
    for number, square in enumerate(squares):
        truth = _place(square.truth)
        for axis, here, there in zip("xy", truth, _place(square.start), strict=True):
            bounds = (-reach - here, reach - here)
            unknowns += parts.unknown_pose(f"box_{number}", "translation", {axis: there - here}, bounds)
    return tuple(unknowns)


def _place(cell: tuple[float, float]) -> np.ndarray:
    return _CELL * np.array(cell)
