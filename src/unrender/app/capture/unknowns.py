"""Unknowns of an asset by name: their keys, textures, bounds and initial values, and the stages that recover them.

Unknowns of the camera:

| unknown | shape | model |
|---|---|---|
| `exposure` | three per training view | factor 2^e per channel, less the mean over views |
| `vignetting` | three | factor 2^(a₁ r² + a₂ r⁴ + a₃ r⁶), r = 1 at the corners |
| `response` | two per channel | a rising curve from 0 to 0 and 1 to 1; 0 is sRGB |
| `poses` | six per training view | rotation in degrees and a shift of similar effect; common motions are projected out |

The curve of `--response fit` is f(x) = m(x)^γ with m(x) = eᵇ x / (1 + (eᵇ - 1) x), γ = exp(c) and b = d + 1.6 c, with unknown contrast c
and brightness d. If light and object stand still together, the colour can explain any curve.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unrender.app.stages.stages_file import Stage, Stages
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.rendering.camera_poses import POSES
from unrender.rendering.exposure import EXPOSURE, VIGNETTING
from unrender.rendering.photographs import check_response
from unrender.rendering.response import RESPONSE

NAMES = ("colour", "roughness", "metallic", "normal", "shape", "light", "exposure", "vignetting", "response", "poses")
DEFAULT = ("colour", "roughness", "metallic", "light")
OF_HULL = ("colour", "roughness", "metallic", "normal", "light")
"""Default unknowns for a hull, whose normals lack concavities."""
_MATERIALS = ("colour", "light", "roughness", "metallic")
COLOUR, ROUGHNESS = 0.4, 0.6
_SMOOTHEST, _SMOOTHEST_WITH_NORMALS = 0.02, 0.25
"""Minimum roughness, without and with normals. If a lobe is narrower than a texel of the light, derivatives by normals, which grow with
its inverse square, are mostly noise."""
_METALLIC = 0.1  # initial value, above the bound 0
_FLAT = (0.5, 0.5, 1.0)  # normal map value that does not change the surface normal
_STRENGTH, _VERTEX_RATE = 20.0, 1e-3
"""Strength of the large-steps preconditioner, and initial learning rate of vertices relative to the mesh's diagonal."""
_COARSER = 4
_OF_PICTURES = ("exposure", "vignetting", "response")  # unknowns that are optimised in all stages
_NORMALS_RATE, _LATE = 0.01, {"learning_rate": 0.02}
"""Initial learning rate of a normal map, and later rate of `auto` for the others, a fifth of that of the first stages."""
_DETAIL = {**_LATE, "correlation": 1 / 128}
"""Settings of the last stages: coarse structure has converged, and detail needs gradients with less smoothing."""
_POSE_RATE = 0.05  # initial learning rate of poses, in degrees and equivalent units
_RESPONSE_RATE = 0.2  # initial learning rate of the response's contrast and brightness


def parse(text: str) -> tuple[str, ...]:
    """Parse a list such as "colour,light" to names in the order of `NAMES`. Raise `InputError`."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise InputError(f"--unknowns: expected some of {', '.join(NAMES)}, such as {','.join(DEFAULT)}")
    for name in names:
        if name not in NAMES:
            expected = did_you_mean(name, NAMES) or f"; expected some of {', '.join(NAMES)}"
            raise InputError(f"--unknowns: no {name}{expected}")
    check_response(names)
    return tuple(name for name in NAMES if name in names)


def keys(unknowns: Sequence[str]) -> dict[str, str]:
    """Return {name: the parameter's key} of all names. A normal map nests the material."""
    material = "asset.bsdf.nested_bsdf" if "normal" in unknowns else "asset.bsdf"
    return {
        "colour": f"{material}.base_color.data",
        "roughness": f"{material}.roughness.data",
        "metallic": f"{material}.metallic.data",
        "normal": "asset.bsdf.normalmap.data",
        "shape": "asset.vertex_positions",
        "light": "light.data",
        "exposure": EXPOSURE,
        "vignetting": VIGNETTING,
        "response": RESPONSE,
        "poses": POSES,
    }


def parameters(unknowns: Sequence[str], diagonal: float) -> list[dict[str, Any]]:
    """Return the [[parameters]] of a problem file. `diagonal` is that of the mesh's bounding box, > 0."""
    of = keys(unknowns)
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
    """Return {attribute of the material: (file in the texture folder, initial values (size, size, C))}; `normalmap` belongs to the map
    around it."""
    textures_by_name = {"base_color": ("base-colour.exr", np.full((size, size, 3), COLOUR, np.float32))}
    if "roughness" in unknowns:
        textures_by_name["roughness"] = ("roughness.exr", np.full((size, size, 1), ROUGHNESS, np.float32))
    if "metallic" in unknowns:
        textures_by_name["metallic"] = ("metallic.exr", np.full((size, size, 1), _METALLIC, np.float32))
    if "normal" in unknowns:
        textures_by_name["normalmap"] = ("normal.exr", np.broadcast_to(np.array(_FLAT, np.float32), (size, size, 3)))
    return textures_by_name


def stages(unknowns: Sequence[str], problem: Path) -> Stages:
    """Return the stages: materials and light at low resolution, then at full resolution, normals, detail of all, and the shape.

    Unknowns of earlier stages remain active, with smaller rates from the normals on and with less gradient smoothing at the end. Poses
    are active from the second stage on, since they require a texture.
    """
    of, result = keys(unknowns), []
    moved: list[str] = []

    def add(name: str, more: Sequence[str], share: float, coarser: int = 1, settings: Any = ()) -> None:
        new = [one for one in more if one in unknowns]
        if new:
            moved.extend(one for one in new if one not in moved)
            moving = [one for one in NAMES if one in unknowns and one in (*moved, *_OF_PICTURES)]
            result.append(Stage(name, tuple(of[one] for one in moving), share, coarser, settings=dict(settings)))

    add("coarse-materials", _MATERIALS, 1.0, _COARSER)
    add("materials", (*_MATERIALS, "poses"), 3.0)
    add("normals", ("normal",), 4.0, settings=_LATE)
    add("detail", tuple(moved), 4.0, settings=_DETAIL)
    add("shape", ("shape",), 1.0, settings=_DETAIL)
    rest = [name for name in _OF_PICTURES if name in unknowns]
    return Stages(problem, tuple(result or [Stage("photographs", tuple(of[name] for name in rest))]))
