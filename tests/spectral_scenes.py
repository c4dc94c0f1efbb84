"""A small scene for tests of spectral variants."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

SIZE, DEPTH = 8, 4
TEXTURE, SPECTRUM = "back.bsdf.reflectance.data", "ball.bsdf.reflectance.values"
COLOUR, ROUGHNESS = "shiny.bsdf.base_color.value", "shiny.bsdf.roughness.value"
KEYS = (TEXTURE, SPECTRUM, COLOUR, ROUGHNESS)


def texels() -> np.ndarray:
    """Colours that are inside the cells of Mitsuba's table, where its derivative is continuous."""
    return np.random.default_rng(0).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)


def spectrum(*values: float) -> dict[str, Any]:
    return {
        "type": "regular",
        "wavelength_min": 400,
        "wavelength_max": 700,
        "values": ", ".join(map(str, values)),
    }


def scene(**others: Any) -> dict[str, Any]:
    """A wall with a texture, a ball with a spectrum, and a principled ball, lit by a lamp and a sky; with other entries."""
    look = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(texels()), "raw": False}
    colour = {"type": "rgb", "value": [0.71, 0.31, 0.12]}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 50, "to_world": look, "film": film},
        "back": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(2),
            "bsdf": {"type": "diffuse", "reflectance": picture},
        },
        "ball": {
            "type": "sphere",
            "radius": 0.6,
            "center": [0.5, 0.3, 0.8],
            "bsdf": {"type": "diffuse", "reflectance": spectrum(0.1, 0.2, 0.7, 0.8)},
        },
        "shiny": {
            "type": "sphere",
            "radius": 0.5,
            "center": [-0.7, -0.5, 0.8],
            "bsdf": {"type": "principled", "base_color": colour, "roughness": 0.4, "metallic": 0.5},
        },
        "lamp": {
            "type": "sphere",
            "radius": 0.3,
            "center": [0, 2, 3],
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [20, 15, 10]}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.4, 0.6]}},
        **others,
    }
