"""Pieces that the gallery's scenes share: the camera, surfaces, lights, as Mitsuba dictionaries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

Vector = Sequence[float] | np.ndarray


def camera(origin: Vector, target: Vector, fov: float, resolution: int) -> dict[str, Any]:
    """A pinhole camera, y upwards, with a square film and a box filter: each pixel's samples are its own.

    Args:
        origin: where it stands.
        target: what is in the middle of its picture.
        fov: full angle in degrees.
        resolution: pixels along a side.
    """
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(list(map(float, origin)), list(map(float, target)), [0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": resolution,
            "height": resolution,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }


def rectangle(centre: Vector, right: Vector, up: Vector, bsdf: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A rectangle that faces `right` × `up`; a texture on it stands upright for who looks at its face.

    Args:
        centre: its middle.
        right, up: from the middle to the middle of two edges; perpendicular.
        bsdf: its material.
        more: further entries, such as an emitter.
    """
    x, y = np.asarray(right, float), np.asarray(up, float)
    normal = np.cross(x, y)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = x, y, normal / np.linalg.norm(normal)
    matrix[:3, 3] = centre
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix.tolist()), "bsdf": bsdf, **more}


def colour(*rgb: float) -> dict[str, Any]:
    """A colour in linear RGB; one number is grey."""
    return {"type": "rgb", "value": list(rgb) if len(rgb) == 3 else [rgb[0]] * 3}


def diffuse(*rgb: float) -> dict[str, Any]:
    """A diffuse material, seen from one side."""
    return {"type": "diffuse", "reflectance": colour(*rgb)}


def twosided(bsdf: dict[str, Any]) -> dict[str, Any]:
    """The material, on both sides."""
    return {"type": "twosided", "bsdf": bsdf}


def light(*rgb: float) -> dict[str, Any]:
    """An area light of that radiance."""
    return {"type": "area", "radiance": colour(*rgb)}
