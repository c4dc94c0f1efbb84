"""`box2` and `box10`: where flat squares lie, from a picture in which no square touches its place.

The plateau task of Fischer and Ritschel 2023, as in Wang et al., section 4. A square that does not overlap its place in the reference
can be moved a little without any effect on the loss: its derivative is zero, and only by looking farther can one tell where to go.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, parts, staging
from unrender.losses import L2, Loss
from unrender.scene.parameter import Parameter

_GREY = 0.4
"""Of the wall behind."""

_CELL = 0.45
"""Places are cells of a grid of 4 by 4."""

_FAR = 10.0
"""Where the camera is: so far off that squares one before the other neither look larger nor show a shadow."""


@dataclass(frozen=True)
class _Square:
    """One square: its colour, and its place in the truth and at the start, (column, row) in cells from the picture's middle."""

    colour: tuple[float, float, float]
    truth: tuple[float, float]
    start: tuple[float, float]


# No two differ from the wall in the same way: the squares' contrasts are axes of RGB space, of either sign. So a square
# gains nothing by lying on another one's place: only its own attracts it.
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
    """Where one square lies: two numbers, from a start that does not overlap the place sought.

    One view; the unknowns are x and y of the square's translation, kept where the picture shows it whole. A plateau: the loss does not
    change, but for pixels that the square's edges share, until it overlaps its place.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """See `_scene`."""
        return _scene(_ONE, 0.2, self.resolution)

    def parameters(self) -> tuple[Parameter, ...]:
        """The square's place, from the other side of the picture."""
        return _parameters(_ONE, 0.2)


@register(name="box10", position=16)
@dataclass(frozen=True)
class Box10:
    """Where five squares lie: ten numbers, from starts that do not overlap the places sought.

    One view; the unknowns are x and y of each square's translation, kept where the picture shows it whole. A plateau in every coordinate,
    and a square that crosses another one hides it.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """See `_scene`."""
        return _scene(_FIVE, 0.18, self.resolution)

    def parameters(self) -> tuple[Parameter, ...]:
        """The squares' places, each from one that no square of the reference takes."""
        return _parameters(_FIVE, 0.18)


def _scene(squares: tuple[_Square, ...], half: float, resolution: int) -> dict[str, Any]:
    """A grey wall z = 0, x and y in [-1, 1] seen, lit as the camera sees it: what is seen are the colours themselves."""
    return {
        "type": "scene",
        "camera": parts.camera((0, 0, _FAR), (0, 0, 0), 2 * np.degrees(np.arctan(1 / _FAR)), resolution),
        "sun": staging.sun((0, 0, 1), 1.0),
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
    found = []
    for number, square in enumerate(squares):
        truth = _place(square.truth)
        for axis, here, there in zip("xy", truth, _place(square.start), strict=True):
            bounds = (-reach - here, reach - here)
            found += staging.unknown(f"box_{number}", "translation", {axis: there - here}, bounds)
    return tuple(found)


def _place(cell: tuple[float, float]) -> np.ndarray:
    return _CELL * np.array(cell)
