"""The unknowns of an asset by name: their keys, textures, bounds and first values, and the stages that recover them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unrender.app.stages.stages_file import Stage, Stages
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.rendering.camera_poses import POSES
from unrender.rendering.exposure import EXPOSURE
from unrender.rendering.photographs import check_response
from unrender.rendering.response import RESPONSE
from unrender.rendering.vignetting import VIGNETTING

NAMES = ("colour", "roughness", "metallic", "normal", "shape", "light", "exposure", "vignetting", "response", "poses")
DEFAULT = ("colour", "roughness", "metallic", "light")
OF_HULL = ("colour", "roughness", "metallic", "normal", "light")
"""Likewise, of a hull, whose own normals know no hollows."""
_MATERIALS = ("colour", "light", "roughness", "metallic")
COLOUR, ROUGHNESS = 0.4, 0.6
_SMOOTHEST, _SMOOTHEST_WITH_NORMALS = 0.02, 0.25
"""Least roughness. Where a lobe is narrower than a texel of the light, derivatives by normals, which grow as its inverse square, are
noise."""
_METALLIC = 0.1
"""Above 0, which is a bound."""
_FLAT = (0.5, 0.5, 1.0)
"""The normal map of a surface as it is."""
_STRENGTH, _VERTEX_RATE = 20.0, 1e-3
"""Of large steps, and the first step of vertices as a share of the mesh's diagonal."""
_COARSER = 4
_OF_PICTURES = ("exposure", "vignetting", "response")
"""Unknowns that move in all stages."""
_NORMALS_RATE, _LATE = 0.01, {"learning_rate": 0.02}
"""First steps of a normal map; and the rate of `auto` for the others from then on, a fifth of that of the first stages: they settle."""
_DETAIL = {**_LATE, "correlation": 1 / 128}
"""Of what comes last: what is broad has been found, and detail hardly moves along gradients that are smoothed as far."""
_POSE_RATE = 0.05
"""First step of poses, in degrees and units like them."""
_RESPONSE_RATE = 0.2
"""First step of the response's contrast and brightness."""


def parse(text: str) -> tuple[str, ...]:
    """ "colour,light" as names in the order of `NAMES`. Raises `InputError`."""
    given = [name.strip() for name in text.split(",") if name.strip()]
    if not given:
        raise InputError(f"--unknowns: expected some of {', '.join(NAMES)}, such as {','.join(DEFAULT)}")
    for name in given:
        if name not in NAMES:
            expected = did_you_mean(name, NAMES) or f"; expected some of {', '.join(NAMES)}"
            raise InputError(f"--unknowns: no {name}{expected}")
    check_response(given)
    return tuple(name for name in NAMES if name in given)


def keys(unknowns: Sequence[str], turntable: bool = False) -> dict[str, str]:
    """{name: the parameter's key} of all names; under a normal map, the material is nested, and so is the light of a turntable."""
    material = "asset.bsdf.nested_bsdf" if "normal" in unknowns else "asset.bsdf"
    return {
        "colour": f"{material}.base_color.data",
        "roughness": f"{material}.roughness.data",
        "metallic": f"{material}.metallic.data",
        "normal": "asset.bsdf.normalmap.data",
        "shape": "asset.vertex_positions",
        "light": "light.map.data" if turntable else "light.data",
        "exposure": EXPOSURE,
        "vignetting": VIGNETTING,
        "response": RESPONSE,
        "poses": POSES,
    }


def parameters(unknowns: Sequence[str], diagonal: float, turntable: bool = False) -> list[dict[str, Any]]:
    """The [[parameters]] of a problem file. `diagonal`: of the mesh's bounding box, > 0."""
    of = keys(unknowns, turntable)
    unit = {"bounds": [0.0, 1.0]}
    more: dict[str, dict[str, Any]] = {
        "colour": unit,
        "roughness": {"bounds": [_SMOOTHEST_WITH_NORMALS if "normal" in unknowns else _SMOOTHEST, 1.0]},
        "metallic": unit,
        "normal": {**unit, "learning_rate": _NORMALS_RATE},
        "light": {"bounds": [0.0, math.inf]},
        "shape": {
            "learning_rate": _VERTEX_RATE * diagonal,
            "preconditioner": {"type": "LargeSteps", "strength": _STRENGTH},
        },
        "exposure": {},
        "vignetting": {},
        "response": {"learning_rate": _RESPONSE_RATE},
        "poses": {"learning_rate": _POSE_RATE},
    }
    return [{"key": of[name], **more[name]} for name in NAMES if name in unknowns]


def textures(unknowns: Sequence[str], size: int) -> dict[str, tuple[str, np.ndarray]]:
    """{attribute of the material: (file below textures, first values (size, size, C))}; of `normalmap` that of the map around it."""
    found = {"base_color": ("base-colour.exr", np.full((size, size, 3), COLOUR, np.float32))}
    if "roughness" in unknowns:
        found["roughness"] = ("roughness.exr", np.full((size, size, 1), ROUGHNESS, np.float32))
    if "metallic" in unknowns:
        found["metallic"] = ("metallic.exr", np.full((size, size, 1), _METALLIC, np.float32))
    if "normal" in unknowns:
        found["normalmap"] = ("normal.exr", np.broadcast_to(np.array(_FLAT, np.float32), (size, size, 3)))
    return found


def stages(unknowns: Sequence[str], problem: Path, turntable: bool = False) -> Stages:
    """Materials and light at low resolution, then in full, then normals, then the detail of all, then the shape.

    What was moved before keeps moving, from the normals on by shorter steps, and at last by gradients that are smoothed over few texels.
    Poses move from the second stage on, when there is a texture to see them by.
    """
    of, found = keys(unknowns, turntable), []
    moved: list[str] = []

    def add(
        name: str, more: Sequence[str], share: float, coarser: int = 1, settings: dict[str, Any] | None = None
    ) -> None:
        given = [one for one in more if one in unknowns]
        if given:
            moved.extend(one for one in given if one not in moved)
            moving = [one for one in NAMES if one in unknowns and one in (*moved, *_OF_PICTURES)]
            found.append(Stage(name, tuple(of[one] for one in moving), share, coarser, settings=settings))

    add("coarse-materials", _MATERIALS, 1.0, _COARSER)
    add("materials", (*_MATERIALS, "poses"), 3.0)
    add("normals", ("normal",), 4.0, settings=_LATE)
    add("detail", tuple(moved), 4.0, settings=_DETAIL)
    add("shape", ("shape",), 1.0, settings=_DETAIL)
    rest = [name for name in _OF_PICTURES if name in unknowns]
    return Stages(problem, tuple(found or [Stage("photographs", tuple(of[name] for name in rest))]))
