"""Problem `sunlit-vase`: the glaze of a vase in the sun, seen from all sides.

The sun is small and a thousand times brighter than the sky. The lit side of the vase is easy. The sky and the ground light its shaded
side, while most emitter samples go to the sun and are occluded.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.backend import variant
from unrender.core import checks
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.rotations import MITSUBA_TO_OPENGL
from unrender.gallery import fields, meshes, parts, textures
from unrender.io import files
from unrender.losses import L1, Loss
from unrender.scene.parameter import Parameter

SUN = np.array([-0.55, 0.62, 0.56]) / np.linalg.norm([-0.55, 0.62, 0.56])
"""Direction to the sun."""
_SUN_RADIUS = np.radians(2.5)


@register(name="sunlit-vase", position=3)
@dataclass(frozen=True)
class SunlitVase:
    """The painted glaze of a vase under a sky with a small bright sun, seen from all sides.

    Several views. One unknown, the base colour (texture_resolution², 3), initially grey.
    """

    resolution: int = fields.resolution(128)
    texture_resolution: int = fields.texture_resolution(64)
    views: int = fields.integer(3, "cameras, at equal angles around the vase", at_least=1, at_most=16)
    reference_spp: int = fields.reference_spp(384)
    max_depth: int = fields.max_depth(5, at_least=2)
    loss: Loss = field(default=L1(), metadata=fields.LOSS)

    def scene(self) -> dict[str, Any]:
        """Return the vase, 1.7 high, on the ground y = 0 around the y axis."""
        angles = np.pi / 6 + 2 * np.pi * np.arange(self.views) / self.views
        gravel = textures.bitmap(textures.photograph("gravel", 128), repeat=(10, 10))
        return {
            "type": "scene",
            **parts.cameras_around(angles, 4.2, (1.9,), (0, 0.82, 0), 28.0, self.resolution),
            "sky": parts.environment(_sky()),
            "ground": parts.rectangle((0, 0, 0), (15, 0, 0), (0, 0, -15), {"type": "diffuse", "reflectance": gravel}),
            "vase": vase(self.texture_resolution),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the glaze, initially grey."""
        return (Parameter("vase.bsdf.brdf_0.base_color.data", initial=0.5),)


def vase(texture_resolution: int) -> dict[str, Any]:
    """Return the vase with its true glaze."""
    return meshes.sheet("vase", _vase_points(96, 96), _glaze(texture_resolution), closed=True)


def _sky() -> np.ndarray:
    """Return the sky with its sun, see `parts.picture`."""
    return parts.picture(SUN, _SUN_RADIUS, (620.0, 560.0, 460.0))


def _vase_points(rows: int, columns: int) -> np.ndarray:
    """Return a profile with a foot, a belly, a neck and a lip, as a surface of revolution."""
    height = np.linspace(0, 1, rows)
    knots = np.array(
        [
            (0, 0.3),
            (0.04, 0.3),
            (0.1, 0.26),
            (0.3, 0.5),
            (0.5, 0.58),
            (0.68, 0.42),
            (0.84, 0.2),
            (0.94, 0.22),
            (1, 0.32),
        ]
    )
    from scipy.interpolate import PchipInterpolator

    radius = PchipInterpolator(*knots.T)(height)
    return meshes.lathe(radius, 1.7 * height, columns)


def _glaze(resolution: int) -> dict[str, Any]:
    paint = textures.bitmap(_painting(resolution))
    return parts.twosided({"type": "principled", "base_color": paint, "roughness": 0.35, "specular": 0.5})


def _painting(resolution: int) -> np.ndarray:
    """Return bands, a zigzag, dots and petals on terracotta, seamless in u: (resolution, resolution, 3), v = 1 first."""
    u, v = textures.grid(resolution)
    v = 1 - v
    clay, ink, cream, blue = (
        np.array(c) for c in ([0.6, 0.22, 0.1], [0.05, 0.05, 0.07], [0.85, 0.75, 0.55], [0.08, 0.25, 0.6])
    )

    def within(x: np.ndarray, low: float, high: float | np.ndarray) -> np.ndarray:
        edge = 0.012
        return textures.ramp(x, low - edge, low + edge) * (1 - textures.ramp(x, high - edge, high + edge))

    saw = np.abs((8 * u) % 1 - 0.5) * 2
    petals = np.sqrt(np.abs(np.sin(6 * np.pi * u)))
    dots = np.hypot(((12 * u) % 1 - 0.5) / 12 * 2.2, v - 0.66)
    layers = [
        (within(v, 0.0, 0.09), ink),
        (within(v, 0.12, 0.12 + 0.2), cream),
        (within(v, 0.12, 0.125 + 0.19 * petals), blue),
        (within(v, 0.38, 0.58), ink),
        (within(v - 0.08 * saw, 0.41, 0.475), cream),
        (1 - textures.ramp(dots, 0.025, 0.045), cream),
        (within(v, 0.72, 0.74), ink),
        (within(v, 0.8, 0.9), blue),
        (within(v, 0.94, 1.1), ink),
    ]
    picture = np.broadcast_to(clay, (resolution, resolution, 3))
    for cover, paint in layers:
        picture = picture + (paint - picture) * cover[..., None]
    return picture.astype(np.float32)


_FIELD_OF_VIEW = 30.0
_DISTANCE, _MIDDLE = 4.4, 0.85
_TEXELS, _MAX_DEPTH = 64, 5
_WHITE = 0.98
"""Linear value to which the exposure maps the 99.9th percentile of all values."""


def photographs(folder: str | Path, views: int = 24, size: int = 128, spp: int = 256, seed: int = 0) -> Path:
    """Render photographs of a glazed vase under the sky from a camera that moves around it.

    The folder contains `images/00.png`, ... (8-bit sRGB; the alpha channel is 1 on the vase) and `transforms.json` with poses and field
    of view in NeRF's format. All have one exposure, at which one value in a thousand is white.

    Args:
        folder: output folder; it must be missing or empty.
        views: number of photographs, >= 3, once around, from heights between the foot of the vase and above its lip.
        size: size of a photograph, (size, size) pixels, >= 8.
        spp: samples per pixel, >= 1.
        seed: seed of the first render, >= 0; each further one adds 1.

    Returns:
        The folder.

    Raises:
        InputError: an argument is out of range, or the folder is not empty or not writable.
    """
    for name, value, least in (("views", views, 3), ("size", size, 8), ("spp", spp, 1), ("seed", seed, 0)):
        checks.integer("photographs", name, value, at_least=least)
    out = Path(folder)
    files.check_replaceable(out, (), "transforms.json", False, f"photographs: {out}", "photographs")
    variant.ensure()
    scene = mi.load_dict({"type": "scene", "sky": parts.environment(_photographed_sky()), "vase": vase(_TEXELS)})
    path = mi.load_dict({"type": "path", "max_depth": _MAX_DEPTH, "hide_emitters": True})
    pictures, frames = [], []
    for index in range(views):
        angle, height = 2 * np.pi * index / views, _MIDDLE + 1.5 * np.sin(2.4 * index)
        level = np.sqrt(_DISTANCE**2 - (height - _MIDDLE) ** 2)
        place = level * np.sin(angle), height, level * np.cos(angle)
        camera = parts.camera(place, (0, _MIDDLE, 0), _FIELD_OF_VIEW, size)
        camera["film"]["pixel_format"] = "rgba"
        camera_ = mi.load_dict(camera)
        picture = mi.render(scene, sensor=camera_, integrator=path, spp=spp, seed=seed + index)  # pyright: ignore[reportArgumentType]
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


def _photographed_sky() -> np.ndarray:
    """Return a sky with a veiled sun, for soft shadows."""
    return parts.picture(SUN, 0.3, (14.0, 12.5, 10.5))
