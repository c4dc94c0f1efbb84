"""Problem `mug`: the rotation of a cup about its axis, from an image that shows its handle.

After Wang et al., section 4. All but the handle is a surface of revolution, so a rotation does not change the image while the handle is
hidden behind the cup. With an unknown label, the pose needs perturbed renders and the texture needs path gradients: see
`estimators/hybrid.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.registry import register
from unrender.core.rotations import rotation
from unrender.gallery import fields, meshes, parts, textures
from unrender.losses import L2, Loss
from unrender.scene.parameter import Parameter

_SIDE = np.radians(105.0)
"""True angle of the handle: 0 faces the camera, a right angle is to the camera's right."""

_HIDDEN = np.radians(158.0)
"""Initial angle of the handle."""

_LABEL_WIDTH, _LABEL_HEIGHTS = np.radians(100.0), (0.24, 0.86)
"""Angle that the label covers, and its lower and upper height."""

_LABEL = "mug.bsdf.brdf_0.bsdf_1.reflectance.data"

_CUP, _ELSEWHERE = (0.0, 0.0), (0.0, 2.0)
"""Origins of texture coordinates: of the cup, and of parts without a label."""


@register(name="mug", position=17)
@dataclass(frozen=True)
class Mug:
    """The rotation of a cup: one angle, with the handle initially hidden behind it.

    One view. The unknown is the rotation about the vertical and, with `label`, also a texture (label², 3) on the cup's front, initially
    grey. A plateau with a barrier: the image does not change until the handle appears from behind the cup. Then the loss increases: on
    the wrong side permanently, on the right side for about 15 degrees, until the handle overlaps its true position. A smoothing of about
    25 degrees or more (σ) overcomes both.
    """

    resolution: int = fields.resolution(48)
    reference_spp: int = fields.reference_spp(1024)
    max_depth: int = fields.max_depth(2, at_least=2)
    label: int = fields.integer(0, "texels along a side of an unknown label on the cup, 0 for no label", at_least=0)
    loss: Loss = field(default=L2(), metadata=fields.LOSS)

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
    """Return the glaze with a label, which faces the camera in the true scene.

    Args:
        glaze: material around the label.
        cup: the cup from `_pieces()`.
        texels: number of texels along a side.
    """
    outside = np.arange(len(cup)) <= np.argmax(cup[:, 0, 1])
    rows = np.flatnonzero(outside & (cup[:, 0, 1] >= _LABEL_HEIGHTS[0]) & (cup[:, 0, 1] <= _LABEL_HEIGHTS[1]))
    bottom, top = rows[[0, -1]] / (len(cup) - 1)
    width = _LABEL_WIDTH / (2 * np.pi)
    left = 0.5 - _SIDE / (2 * np.pi) - width / 2  # u = 0.5 is at the handle
    to = mi.ScalarTransform4f
    inside = to().scale([1 / width, 1 / (top - bottom), 1]) @ to().translate([-left, -bottom, 0])
    upright = to().translate([0, 1, 0]) @ to().scale([1, -1, 1])
    picture = textures.bitmap(textures.photograph("coffee", texels)) | {"to_uv": upright @ inside}
    ninth = to().translate([1 / 3, 1 / 3, 0]) @ to().scale([1 / 3, 1 / 3, 1])
    middle = np.zeros((3, 3), np.float32)
    middle[1, 1] = 1.0
    weight = textures.bitmap(middle) | {"filter_type": "nearest", "to_uv": ninth @ inside}
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
