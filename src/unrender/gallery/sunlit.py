"""Problems `sunlit-vase` and `sun-glossy`: the paint of a vase and of a lacquered wooden doll in the sun, seen from all sides.

The sun is small and a thousand times brighter than the sky. The lit side of the vase is easy. The sky and the ground light its shaded
side, while most emitter samples go to the sun and are occluded. `sun-glossy` is the comparison of losses for adaptive pixel sampling
(Fig. 4 of its paper). The lacquer reflects the sun: a few pixels are many times brighter than the others and dominate L2, whereas a
relative loss includes the shaded side.
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
from unrender.core.geometry import MITSUBA_TO_OPENGL
from unrender.core.registry import register
from unrender.gallery import fields, meshes, parts
from unrender.io import files
from unrender.losses import L1, Loss
from unrender.preconditioners import LargeSteps
from unrender.scene.parameter import Parameter

SUN = parts.unit([-0.55, 0.62, 0.56])
"""Direction to the sun."""
_SUN_RADIUS = np.radians(2.5)


@register(name="sunlit-vase", position=3)
@dataclass(frozen=True)
class SunlitVase(fields.Rendered):
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
        gravel = parts.bitmap(parts.photograph("gravel", 128), repeat=(10, 10))
        return {
            "type": "scene",
            **parts.cameras_around(angles, 4.2, (1.9,), (0, 0.82, 0), 28.0, self.resolution),
            "sky": parts.environment(_sky()),
            "ground": parts.rectangle((0, 0, 0), (15, 0, 0), (0, 0, -15), {"type": "diffuse", "reflectance": gravel}),
            "vase": vase(self.texture_resolution),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("vase.bsdf.brdf_0.base_color.data", initial=0.5),)


def vase(texture_resolution: int) -> dict[str, Any]:
    """Return the vase with its true glaze."""
    paint = parts.bitmap(_painting(texture_resolution))
    glaze = parts.twosided({"type": "principled", "base_color": paint, "roughness": 0.35, "specular": 0.5})
    return meshes.sheet("vase", _vase_points(96, 96), glaze, closed=True)


def _sky() -> np.ndarray:
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


def _painting(resolution: int) -> np.ndarray:
    """Return bands, a zigzag, dots and petals on terracotta, seamless in u: (resolution, resolution, 3), v = 1 first."""
    u, v = parts.grid(resolution)
    v = 1 - v
    clay, ink, cream, blue = (
        np.array(c) for c in ([0.6, 0.22, 0.1], [0.05, 0.05, 0.07], [0.85, 0.75, 0.55], [0.08, 0.25, 0.6])
    )

    def within(x: np.ndarray, low: float, high: float | np.ndarray) -> np.ndarray:
        edge = 0.012
        return parts.ramp(x, low - edge, low + edge) * (1 - parts.ramp(x, high - edge, high + edge))

    saw = np.abs((8 * u) % 1 - 0.5) * 2
    petals = np.sqrt(np.abs(np.sin(6 * np.pi * u)))
    dots = np.hypot(((12 * u) % 1 - 0.5) / 12 * 2.2, v - 0.66)
    layers = [
        (within(v, 0.0, 0.09), ink),
        (within(v, 0.12, 0.12 + 0.2), cream),
        (within(v, 0.12, 0.125 + 0.19 * petals), blue),
        (within(v, 0.38, 0.58), ink),
        (within(v - 0.08 * saw, 0.41, 0.475), cream),
        (1 - parts.ramp(dots, 0.025, 0.045), cream),
        (within(v, 0.72, 0.74), ink),
        (within(v, 0.8, 0.9), blue),
        (within(v, 0.94, 1.1), ink),
    ]
    return _layered(clay, layers)


_FIELD_OF_VIEW = 30.0
_DISTANCE, _MIDDLE = 4.4, 0.85
_TEXELS, _MAX_DEPTH = 64, 5
_WHITE = 0.98  # linear value to which the exposure maps the 99.9th percentile of all values


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
    out = checks.path("photographs: folder", folder)
    files.check_replaceable(out, (), "transforms.json", False, f"photographs: {out}", "photographs")
    variant.ensure()
    sky = parts.environment(parts.picture(SUN, 0.3, (14.0, 12.5, 10.5)))  # a veiled sun, for soft shadows
    scene = mi.load_dict({"type": "scene", "sky": sky, "vase": vase(_TEXELS)})
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

    files.write_folder(out, fill, f"photographs: {out}")
    return out


_DOLL_SUN = parts.unit([0.5, 0.55, 0.67])


@register(name="sun-glossy", position=9)
@dataclass(frozen=True)
class SunGlossy(fields.Rendered):
    """The painted albedo of a glossy doll under a sky with a small bright sun, seen from all sides.

    Several views. One unknown, the diffuse reflectance (texture_resolution², 3) of a rough plastic, initially grey, with LargeSteps.
    Losses of interest are L2 and RelativeL2.
    """

    resolution: int = fields.resolution(64)
    texture_resolution: int = fields.texture_resolution(48)
    views: int = fields.integer(4, "cameras, at equal angles around the doll", at_least=1, at_most=32)
    reference_spp: int = fields.reference_spp(512)
    max_depth: int = fields.max_depth(4, at_least=2)

    def scene(self) -> dict[str, Any]:
        """Return the doll, 1.7 high, on the ground y = 0 around the y axis, facing +z."""
        angles = 0.35 + 2 * np.pi * np.arange(self.views) / self.views
        lacquer = {
            "type": "roughplastic",
            "diffuse_reflectance": parts.bitmap(_doll_painting(self.texture_resolution)),
            "alpha": 0.05,
        }
        return {
            "type": "scene",
            **parts.cameras_around(angles, 4.2, (1.7,), (0, 0.84, 0), 27.0, self.resolution),
            "sky": parts.environment(parts.picture(_DOLL_SUN, np.radians(2.5), (500.0, 450.0, 370.0))),
            "ground": parts.rectangle((0, 0, 0), (60, 0, 0), (0, 0, -60), parts.diffuse(0.3, 0.27, 0.22)),
            "doll": meshes.sheet("doll", meshes.lathe(*_doll_profile(96), 96), lacquer, closed=True),
        }

    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("doll.bsdf.diffuse_reflectance.data", initial=0.4, preconditioner=LargeSteps(1.0)),)


def _doll_profile(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radius and height of body, waist and head, closed at the top."""
    from scipy.interpolate import PchipInterpolator

    knots = np.array(
        [(0, 0.4), (0.12, 0.52), (0.32, 0.58), (0.52, 0.48), (0.62, 0.37), (0.72, 0.39), (0.84, 0.34), (0.93, 0.22)]
    )
    height = 1 - (1 - np.linspace(0, 1, rows)) ** 1.5  # more rows near the top, where the profile turns inward
    body = PchipInterpolator(*knots.T)(np.minimum(height, 0.93))
    cap = 0.22 * np.sqrt(np.clip(1 - ((height - 0.93) / 0.07) ** 2, 1e-4, None))
    return np.where(height > 0.93, cap, body), 1.7 * height


def _doll_painting(resolution: int) -> np.ndarray:
    """Return a face in a scarf, an apron with flowers and a skirt with dots, seamless in u: (resolution, resolution, 3), v = 1 first."""
    u, v = parts.grid(resolution)
    v = 1 - v**1.5  # height, as the profile's rows have it
    skirt, scarf, skin, white = ([0.65, 0.06, 0.05], [0.85, 0.5, 0.06], [0.85, 0.62, 0.45], [0.85, 0.83, 0.75])
    black, leaf, blue, pink = [0.05, 0.04, 0.04], [0.08, 0.35, 0.1], [0.06, 0.15, 0.5], [0.85, 0.25, 0.3]

    def spot(u0: float, v0: float, radius: float, stretch: float = 1.6) -> np.ndarray:
        distance = np.hypot((u - u0) * stretch, v - v0)
        return 1 - parts.ramp(distance, radius - 0.012, radius + 0.012)

    def band(low: float, high: float) -> np.ndarray:
        return parts.ramp(v, low - 0.012, low + 0.012) * (1 - parts.ramp(v, high - 0.012, high + 0.012))

    lattice = np.hypot(((12 * u) % 1 - 0.5) / 12 * 1.8, (v * 8 % 1 - 0.5) / 8)
    dots = 1 - parts.ramp(lattice, 0.025, 0.045)
    petals = sum(spot(0.5 + 0.055 * np.cos(a), 0.32 + 0.085 * np.sin(a), 0.055) for a in 2 * np.pi * np.arange(5) / 5)
    layers = [
        (dots * band(0.0, 0.58), scarf),
        (band(-0.1, 0.05), black),
        (spot(0.5, 0.3, 0.24), white),
        (spot(0.4, 0.2, 0.05) + spot(0.6, 0.2, 0.05), leaf),
        (np.clip(petals, 0, 1), pink),
        (spot(0.5, 0.32, 0.04), scarf),
        (band(0.6, 1.2), scarf),
        (band(0.6, 0.64), blue),
        (dots * band(0.66, 0.94), blue),
        (spot(0.5, 0.77, 0.12, 0.9), black),
        (spot(0.5, 0.765, 0.105, 0.9), skin),
        (spot(0.45, 0.79, 0.022) + spot(0.55, 0.79, 0.022), black),
        (spot(0.5, 0.72, 0.022, 0.8), skirt),
    ]
    return _layered(skirt, layers)


def _layered(ground: Any, layers: list[tuple[Any, Any]]) -> np.ndarray:
    """Return the ground under layers of paint, (H, W, 3) float32, each with its coverage (H, W)."""
    picture = np.asarray(ground)
    for cover, paint in layers:
        picture = parts.mix(picture, np.asarray(paint), np.clip(cover, 0, 1))
    return picture.astype(np.float32)
