"""`mug`: how far a cup is turned about its axis, from a picture that shows its handle.

After Wang et al., section 4. All but the handle is a solid of revolution, so while the handle is hidden behind the cup, a turn changes
nothing in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts, staging
from unrender.losses import L2, Loss
from unrender.problem.parameter import Parameter

__all__ = ["Mug"]

_SIDE = np.radians(105.0)
"""Where the handle is in truth: 0 is towards the camera, a right angle to its right."""

_HIDDEN = np.radians(158.0)
"""Where it is at the start."""


@register(name="mug", position=17)
@dataclass(frozen=True)
class Mug:
    """How far a cup is turned: one angle, its handle hidden behind it at the start.

    One view; the unknown is the rotation about the vertical. A plateau, and a pit: the picture stays the same until the handle comes out
    from behind the cup; then the loss rises, on the wrong side for good, on the right side for some 15 degrees, where the handle does
    not yet lie over its place. A smoothing of about 25 degrees or more (σ) sees beyond.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """The cup: 1 high, on a table y = 0, around the y axis; the camera and the sun, which is higher, in front of it."""
        cup = parts.twosided(parts.diffuse(0.75, 0.3, 0.15))
        return {
            "type": "scene",
            "camera": parts.camera((0, 1.5, 3.6), (0, 0.42, 0), 30.0, self.resolution),
            "sun": staging.sun((0, 0.5, 1), 1.0),
            "table": parts.rectangle((0, 0, 0), (6, 0, 0), (0, 0, -4), parts.diffuse(0.3, 0.35, 0.4)),
            "wall": parts.rectangle((0, 2, -4), (6, 0, 0), (0, 2, 0), parts.diffuse(0.5, 0.5, 0.45)),
            "mug": meshes.sheets("mug", [meshes.Sheet(piece @ _turn(_SIDE).T) for piece in _pieces()], cup),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """The angle; counted from the truth."""
        return tuple(staging.unknown("mug", "rotation", {"y": _HIDDEN - _SIDE}))


def _turn(angle: float) -> np.ndarray:
    """The rotation about y that takes +z to +x at a right angle."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _pieces() -> list[np.ndarray]:
    """Cup, handle (towards +z) and saucer. The saucer reaches farther than the handle, so that the middle of the mesh's bounding box,
    about which poses turn, lies on the axis."""
    cup = [(0, 0.03), (0.2, 0.03), (0.3, 0.04), (0.34, 0.12), (0.4, 0.5), (0.44, 0.98), (0.425, 1), (0.41, 0.98)]
    cup += [(0.37, 0.5), (0.31, 0.15), (0.25, 0.1), (0, 0.1)]
    saucer = [(0, 0.005), (0.5, 0.005), (0.88, 0.075), (0.9, 0.09), (0.87, 0.09), (0.5, 0.03), (0, 0.03)]
    bend = np.linspace(np.radians(118), np.radians(-118), 24)
    path = np.stack([0.45 + 0.33 * np.cos(bend), 0.55 + 0.27 * np.sin(bend), 0 * bend], -1)
    handle = meshes.sweep(path, 0.09, 16) @ _turn(-np.pi / 2).T
    return [_lathe(cup, 40), handle, _lathe(saucer, 30)]


def _lathe(knots: list[tuple[float, float]], rows: int) -> np.ndarray:
    """A profile of straight lines through the knots, evenly sampled, turned."""
    corners = np.array(knots)
    corners[:, 0] = np.maximum(corners[:, 0], 1e-3)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    where = np.union1d(length, np.linspace(0, length[-1], rows))
    return meshes.lathe(np.interp(where, length, corners[:, 0]), np.interp(where, length, corners[:, 1]), 96)
