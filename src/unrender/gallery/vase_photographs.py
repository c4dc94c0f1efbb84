"""Photographs made by code: a folder to try `unrender import` on."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np

from unrender.backend import variant
from unrender.core import checks
from unrender.core.errors import InputError
from unrender.gallery import parts, skies, sunlit_vase
from unrender.io import files
from unrender.rendering.camera_axes import MITSUBA_TO_OPENGL

__all__ = ["photographs"]

_FIELD_OF_VIEW = 30.0
_DISTANCE, _MIDDLE = 4.4, 0.85
_TEXELS, _MAX_DEPTH = 64, 5
_WHITE = 0.98
"""Of the brightest pixel but one in a thousand."""


def photographs(folder: str | Path, views: int = 24, size: int = 128, spp: int = 256, seed: int = 0) -> Path:
    """Render photographs of a glazed vase under the sky, as a camera that goes around it would take them.

    The folder then holds `images/00.png`, ... (8-bit sRGB; the alpha channel is 1 on the vase) and `transforms.json`, poses and angle of
    view as NeRF has them. One exposure serves all: one pixel in a thousand is white.

    Args:
        folder: where to write; it must not exist, or be empty.
        views: photographs, >= 3: once around, from heights between the foot of the vase and above its lip.
        size: of a photograph, (size, size) pixels, >= 8.
        spp: samples per pixel.
        seed: of the renders.

    Returns: the folder.

    Raises:
        InputError: an argument out of its range, or a folder that holds something or cannot be written.
    """
    for name, value, least in (("views", views, 3), ("size", size, 8), ("spp", spp, 1), ("seed", seed, 0)):
        checks.integer("photographs", name, value, at_least=least)
    out = Path(folder)
    files.check_replaceable(out, (), "transforms.json", False, f"photographs: {out}", "photographs")
    variant.ensure()
    scene = mi.load_dict({"type": "scene", "sky": skies.environment(_sky()), "vase": sunlit_vase.vase(_TEXELS)})
    path = mi.load_dict({"type": "path", "max_depth": _MAX_DEPTH, "hide_emitters": True})
    pictures, frames = [], []
    for index in range(views):
        angle, height = 2 * np.pi * index / views, _MIDDLE + 1.5 * np.sin(2.4 * index)
        level = np.sqrt(_DISTANCE**2 - (height - _MIDDLE) ** 2)
        place = level * np.sin(angle), height, level * np.cos(angle)
        camera = parts.camera(place, (0, _MIDDLE, 0), _FIELD_OF_VIEW, size)
        camera["film"]["pixel_format"] = "rgba"
        seen = mi.load_dict(camera)
        picture = mi.render(scene, sensor=seen, integrator=path, spp=spp, seed=seed + index)  # pyright: ignore[reportArgumentType]
        pictures.append(np.array(picture))
        matrix = np.array(camera["to_world"].matrix) @ MITSUBA_TO_OPENGL
        frames.append({"file_path": f"images/{index:02}.png", "transform_matrix": matrix.tolist()})
    white = np.quantile(np.stack(pictures)[..., :3], 0.999) / _WHITE

    def fill(made: Path) -> None:
        (made / "images").mkdir()
        for picture, frame in zip(pictures, frames, strict=True):
            shown = mi.Bitmap(picture / np.array([white, white, white, 1], np.float32))
            shown = shown.convert(mi.Bitmap.PixelFormat.RGBA, mi.Struct.Type.UInt8, True)
            shown.write(str(made / str(frame["file_path"])))
        document = {"camera_angle_x": np.radians(_FIELD_OF_VIEW), "frames": frames}
        (made / "transforms.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")

    try:
        files.write_folder(out, fill)
    except OSError as error:
        raise InputError(f"photographs: {out}: {error.strerror or error}") from error
    return out


def _sky() -> np.ndarray:
    """A sky whose sun is veiled, so that shadows are soft."""
    return skies.picture(sunlit_vase.SUN, 0.3, (14.0, 12.5, 10.5))
