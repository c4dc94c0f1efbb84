"""Photographs made by code: a folder to try `unrender import` on."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np

from unrender.backend import variant
from unrender.core import checks
from unrender.core.errors import InputError
from unrender.gallery import skies, sunlit_vase
from unrender.io import files

__all__ = ["photographs"]

_FIELD_OF_VIEW = 30.0
_DISTANCE, _MIDDLE = 4.4, 0.85
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
    place = Path(folder)
    files.check_replaceable(place, (), "transforms.json", False, f"photographs: {place}", "photographs")
    variant.ensure()
    problem = sunlit_vase.SunlitVase()
    described = {"type": "scene", "sky": skies.environment(_sky()), "vase": problem.scene()["vase"]}
    scene = mi.load_dict(described)
    path = mi.load_dict({"type": "path", "max_depth": problem.max_depth, "hide_emitters": True})
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    pictures, frames = [], []
    for index in range(views):
        angle, height = 2 * np.pi * index / views, _MIDDLE + 1.5 * np.sin(2.4 * index)
        level = np.sqrt(_DISTANCE**2 - (height - _MIDDLE) ** 2)
        pose = mi.ScalarTransform4f().look_at(
            origin=[level * np.sin(angle), height, level * np.cos(angle)], target=[0, _MIDDLE, 0], up=[0, 1, 0]
        )
        camera = mi.load_dict({"type": "perspective", "fov": _FIELD_OF_VIEW, "to_world": pose, "film": film})
        picture = mi.render(scene, sensor=camera, integrator=path, spp=spp, seed=seed + index)  # pyright: ignore[reportArgumentType]
        pictures.append(np.array(picture))
        # Mitsuba's cameras have x to the left and look along +z, OpenGL's have x to the right and look along -z.
        matrix = np.array(pose.matrix) @ np.diag([-1, 1, -1, 1])
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
        files.write_folder(place, fill)
    except OSError as error:
        raise InputError(f"photographs: {place}: {error.strerror or error}") from error
    return place


def _sky() -> np.ndarray:
    """A sky whose sun is veiled, so that shadows are soft."""
    return skies.picture(np.array([-0.55, 0.62, 0.56]) / np.linalg.norm([-0.55, 0.62, 0.56]), 0.3, (14.0, 12.5, 10.5))
