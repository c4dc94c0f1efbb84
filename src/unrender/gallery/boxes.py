"""Problems `box2` and `box10`: positions of flat squares, from an image in which no square overlaps its true position.

The plateau task of Fischer and Ritschel 2023, as in Wang et al., section 4. Small motions of a square that does not overlap its true
position do not change the loss. Its derivative is zero, and only larger motions show the direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, parts
from unrender.losses import L2, Loss
from unrender.scene.parameter import Parameter

_GREY = 0.4
"""Colour of the wall."""

_CELL = 0.45
"""Positions are cells of a 4 by 4 grid."""

_FAR = 10.0
"""Position of the camera, so distant that squares at different depths have equal size and show no shadow."""


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
class Box2:
    """The position of a square: two numbers, initially without overlap with the true position.

    One view. The unknowns are x and y of the square's translation, bounded to the image. A plateau: until the square overlaps its true
    position, the loss changes only at pixels that the square's edges share.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the scene, see `_scene`."""
        return _scene(_ONE, 0.2, self.resolution)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the square's position, initially on the other side of the image."""
        return _parameters(_ONE, 0.2)


@register(name="box10", position=16)
@dataclass(frozen=True)
class Box10:
    """The positions of five squares: ten numbers, initially without overlap with the true positions.

    One view. The unknowns are x and y of each square's translation, bounded to the image. Every coordinate has a plateau, and squares can
    occlude each other.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the scene, see `_scene`."""
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
