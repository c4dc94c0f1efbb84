"""A made capture: photographs of a painted body under a sky, with nuisances, as a folder that `unrender import` reads."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image
from scipy import ndimage

from benchmarks.internals import (
    MITSUBA_TO_OPENGL,
    Camera,
    CapturedMesh,
    Corrections,
    falloff,
    light_turns,
    ply,
    srgb,
    srgb_to_linear,
)

__all__ = ["NUISANCES", "RESPONSE", "TURNTABLE", "Made", "make", "responded", "truth"]

VIEWS, TEXELS, FIELD_OF_VIEW, DISTANCE = 8, 32, 32.0, 4.0
DRIFT, ERROR, SHIFT, QUALITY = 0.3, 0.5, 2, 90
"""Stops, degrees, pixels, of JPEG."""
DISTORTION = {"k1": -0.25, "k2": 0.08}
LENS_FALLOFF = np.array([-0.8, 0.2, -0.2])
"""Stops: 0.8 at the corners, that is a factor of 0.57."""
NUISANCES = ("distortion", "exposure", "vignetting", "poses", "masks", "jpeg")
RESPONSE, TURNTABLE = "response", "turntable"
"""Another curve than sRGB; light that stands still before the camera: of captures of their own, as unknown exposures hide a response."""
CONTRAST, _HEADROOM = 0.6, 0.85
_FINE = 4
_WIDER = 1.25
_WALL = 0.05


@dataclass(frozen=True)
class Made:
    """What was put into a capture.

    Attributes:
        drift: exposures, (V, 3), in stops.
        vignetting: at the corners, in stops.
        rows: corrections of the poses that would undo their errors, as `Corrections` has them, (V, 6); to first order.
        cameras: the poses of the folder, (V, 4, 4).
        responded: whether the camera's curve is `responded`.
        sky: the light as the photographs' values have it, (16, 32, 3).
    """

    drift: np.ndarray
    vignetting: float
    rows: np.ndarray
    cameras: np.ndarray
    responded: bool
    sky: np.ndarray


def body() -> CapturedMesh:
    """A lobed lathe, that no turn maps to itself."""
    rows, columns = 48, 64
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    angle, radius = 2 * np.pi * u, 0.05 + 0.75 * np.sin(np.pi * v) ** 0.6
    radius = radius * (1 + 0.15 * np.cos(angle) * np.sin(2 * np.pi * v) + 0.12 * np.cos(3 * angle + 4 * v))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 2 * v - 1], -1).reshape(-1, 3)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    corner = [first, first + 1, first + columns + 1, first + columns]
    faces = np.concatenate([np.stack([corner[k] for k in pick], 1) for pick in ((0, 1, 2), (0, 2, 3))])
    return CapturedMesh(points, faces, np.stack([u, v], -1).reshape(-1, 2))


def truth() -> tuple[np.ndarray, np.ndarray]:
    """Base colour (T, T, 3) and sky (16, 32, 3)."""
    rng = np.random.default_rng(0)
    smooth = ndimage.gaussian_filter(rng.uniform(0, 1, (TEXELS, TEXELS, 3)), (1.2, 1.2, 0), mode="wrap")
    colour = np.interp(smooth, (smooth.min(), smooth.max()), (0.15, 0.8)).astype(np.float32)
    sky = 0.3 + 2 * ndimage.gaussian_filter(rng.exponential(1.0, (16, 32, 3)), (1.5, 1.5, 0), mode="wrap")
    return colour, sky.astype(np.float32)


def responded(x: np.ndarray) -> np.ndarray:
    """Radiance in [0, 1] through a camera whose curve has more contrast than sRGB, decoded as sRGB; none that `response` can be exactly."""
    encoded = srgb(x)
    encoded = encoded + CONTRAST * encoded * (1 - encoded) * (2 * encoded - 1)
    return srgb_to_linear(encoded)


def poses() -> np.ndarray:
    """(V, 4, 4), camera to world, axes right, up, backwards."""
    found = []
    for index in range(VIEWS):
        angle, height = 2 * np.pi * index / VIEWS, 2.0 * np.sin(1 + 2.3 * index)
        level = np.sqrt(DISTANCE**2 - height**2)
        place = [level * np.cos(angle), level * np.sin(angle), height]
        found.append(np.array(mi.ScalarTransform4f().look_at(place, [0, 0, 0], [0, 0, 1]).matrix) @ MITSUBA_TO_OPENGL)
    return np.array(found)


def photograph(scene: Any, pose: np.ndarray, size: int, distortion: dict[str, float], spp: int) -> np.ndarray:
    """(size, size, 4): linear colours and how much of each pixel the body covers, through a lens."""
    # A finer and wider picture by a pinhole, looked up where the lens has it.
    fine, half = round(_FINE * size * _WIDER), np.tan(np.radians(FIELD_OF_VIEW) / 2)
    film = {"type": "hdrfilm", "width": fine, "height": fine, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    wide = {"type": "perspective", "fov": np.degrees(2 * np.arctan(_WIDER * half)), "film": film}
    sensor = mi.load_dict(wide | {"to_world": mi.ScalarTransform4f((pose @ MITSUBA_TO_OPENGL).tolist())})
    path: Any = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    picture = np.array(mi.render(scene, sensor=sensor, integrator=path, spp=spp))
    y, x = (np.mgrid[: _FINE * size, : _FINE * size] + 0.5) / (_FINE * size) * 2 - 1
    x, y = half * x, half * y
    straight = [x, y]
    for _ in range(50 if distortion else 0):  # x_seen = x (1 + k1 r² + k2 r⁴)
        square = straight[0] ** 2 + straight[1] ** 2
        factor = 1 + distortion["k1"] * square + distortion["k2"] * square**2
        straight = [x / factor, y / factor]
    column, row = ((v / (_WIDER * half) + 1) / 2 * fine - 0.5 for v in straight)
    at = [row, column]
    looked = np.stack([ndimage.map_coordinates(picture[..., c], at, order=1, mode="nearest") for c in range(4)], -1)
    return looked.reshape(size, _FINE, size, _FINE, 4).mean((1, 3))


def make(folder: Path, given: tuple[str, ...], size: int, spp: int, told: bool) -> Made:
    """Write images, masks, body.ply and transforms.json.

    Args:
        folder: a new one.
        given: of `NUISANCES`, `RESPONSE` and `TURNTABLE`.
        told: whether transforms.json tells the lens's distortion.
    """
    rng = np.random.default_rng(1)
    drift = rng.normal(0, DRIFT, (VIEWS, 3)) * ("exposure" in given)
    drift -= drift.mean(0)
    true = poses()
    cameras = {v: Camera(f"{v}r", f"{v}t", true[v, :3, 3]) for v in range(VIEWS)}
    corrections = Corrections(cameras)
    errors = rng.normal(size=(VIEWS, 6))
    for part in (errors[:, :3], errors[:, 3:]):
        part *= ERROR * ("poses" in given) / np.linalg.norm(part, axis=1, keepdims=True)
    errors = corrections.projected(errors)
    wrong = true.copy()
    for v, camera in cameras.items():
        moved = corrections.poses(errors)
        wrong[v, :3, :3] = _rotation(moved[camera.rotation]) @ true[v, :3, :3]
        wrong[v, :3, 3] += moved[camera.translation]
    colour, sky = truth()
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    (folder / "body.ply").write_bytes(ply(body()))
    turns = light_turns(true) if TURNTABLE in given else np.eye(3)[None]
    scenes = [mi.load_dict({
        "type": "scene",
        "body": {"type": "ply", "filename": str(folder / "body.ply"), "bsdf": {
            "type": "principled", "roughness": 0.6,
            "base_color": {"type": "bitmap", "bitmap": mi.Bitmap(colour), "raw": True, "wrap_mode": "clamp"},
        }},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": _turned(turn)},
    }) for turn in turns]  # fmt: skip
    distortion = DISTORTION if "distortion" in given else {}
    pictures = [photograph(scenes[v % len(scenes)], pose, size, distortion, spp) for v, pose in enumerate(true)]
    white = np.quantile(np.stack([p[..., :3][p[..., 3] > 0.99].max() for p in pictures]), 0.5)
    scale = (_HEADROOM if RESPONSE in given else 1.0) / white
    frames = []
    for v, picture in enumerate(pictures):
        values = picture[..., :3] + (1 - picture[..., 3:]) * _WALL * white
        if "vignetting" in given:
            values = values * falloff(LENS_FALLOFF, size, size)
        values = values * 2.0 ** drift[v] * scale
        values = responded(np.clip(values, 0, 1)) if RESPONSE in given else values
        mask = picture[..., 3]
        mask = np.roll(mask, (SHIFT, -SHIFT), (0, 1)) if "masks" in given else mask
        Image.fromarray(np.uint8(np.round(255 * mask))).save(folder / "masks" / f"{v}.png")
        name = f"images/{v}.{'jpg' if 'jpeg' in given else 'exr'}"
        if "jpeg" in given:
            Image.fromarray(np.uint8(np.round(255 * srgb(values)))).save(folder / name, quality=QUALITY, subsampling=0)
        else:
            mi.Bitmap(values.astype(np.float32)).write(str(folder / name))
        frames.append({"file_path": name, "transform_matrix": wrong[v].tolist()})
    focal = size / (2 * np.tan(np.radians(FIELD_OF_VIEW) / 2))
    lens = {"fl_x": focal, "fl_y": focal, "cx": size / 2, "cy": size / 2, "w": size, "h": size}
    lens |= distortion if told else {}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), encoding="utf-8")
    vignetting = float(LENS_FALLOFF.sum()) if "vignetting" in given else 0.0
    return Made(drift, vignetting, -errors, wrong, RESPONSE in given, scale * sky)


def _turned(rotation: np.ndarray) -> Any:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return mi.ScalarTransform4f(matrix.tolist())


def _rotation(vector: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vector).as_matrix()
