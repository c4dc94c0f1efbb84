"""A turntable video of a result, under a selected light."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.app.evaluation import scenes, videos
from unrender.app.exporting.asset import read_environment
from unrender.backend import variant
from unrender.core import phases
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.losses.metrics import exposure, srgb
from unrender.rendering.mitsuba import turntable_light
from unrender.runs import reopen
from unrender.runs.folder import reader as folders

BACKGROUNDS = {"light": None, "black": 0.0, "grey": 0.18, "white": 1.0}
"""Backgrounds of the object: the light itself (None), or a linear value."""
_ANGLE = 35.0
_MARGIN = 1.05
_MOST_FRAMES, _LARGEST = 10_000, 4096


@dataclass(frozen=True)
class _Table:
    """The placement of the camera: centre `middle` and `radius` of a bounding sphere, the axis `up`, and the horizontal direction
    `front`."""

    middle: np.ndarray
    radius: float
    up: np.ndarray
    front: np.ndarray

    def camera(self, elevation: float) -> np.ndarray:
        """Return Mitsuba's `to_world`, (4, 4), of the camera at an elevation in degrees."""
        angle = np.radians(elevation)
        direction = np.cos(angle) * self.front + np.sin(angle) * self.up
        distance = _MARGIN * self.radius / np.sin(np.radians(_ANGLE / 2))
        origin = self.middle + distance * direction
        look = mi.ScalarTransform4f().look_at(origin.tolist(), self.middle.tolist(), self.up.tolist())
        return np.array(look.matrix, float).reshape(4, 4)

    def turned(self, angle: float) -> np.ndarray:
        """Return the rotation of the world, (4, 4), by an angle in radians about the axis through the centre."""
        transform = np.eye(4)
        axis = np.array(self.up)
        k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        transform[:3, :3] = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
        transform[:3, 3] = self.middle - transform[:3, :3] @ self.middle
        return transform


@exclusive("turntable")
def turntable(
    run: str | Path,
    out: str | Path,
    environment: str | Path | None = None,
    frames: int = 48,
    rate: float = 24.0,
    size: int = 320,
    spp: int = 64,
    elevation: float = 15.0,
    up: Sequence[float] | None = None,
    background: str = "light",
    overwrite: bool = False,
) -> Path:
    """Render a video of one rotation of the result of a run in front of a fixed camera under a fixed light.

    All frames have the exposure of the first frame; with a plain background, that of the object alone.

    Args:
        run: a run folder.
        out: a name that ends in .mp4 (needs imageio-ffmpeg) or .gif, or a folder for PNG files.
        environment: an environment map that replaces the lights of the scene; its upper edge is `up`.
        frames: number of frames, >= 1.
        rate: frames per second, > 0.
        size: width and height in pixels, even.
        spp: samples per pixel.
        elevation: elevation of the camera in degrees above the horizon, in (-90, 90).
        up: the axis, (3,); None for the mean of the cameras' up axes, or y for a single camera.
        background: "light", "black", "grey", "white".
        overwrite: whether existing files at `out` may be replaced.

    Returns:
        The path of the video.

    Raises:
        InputError: no result, no surface, an option out of range, or `out` cannot be written. No files remain after an error.
    """
    variant.ensure()
    place = Path(out)
    _check(frames, rate, size, spp, elevation, background)
    axis = None if up is None else _axis(up)
    videos.check(place, overwrite)
    light = None if environment is None else scenes.read_light(Path(environment))
    result = folders.read(run)
    problem = reopen.with_meshes(reopen.problem_of(run), result)
    with tempfile.TemporaryDirectory() as scratch:
        path = scenes.export_scene(problem, problem.full(result.parameters), Path(scratch) / "scene")
        scene = scenes.load_scene(path)
        axis = scenes.up_axis(list(scene.sensors())) if axis is None else axis
        table = _table(scene, axis, problem.name)
        if light is not None:
            scene = scenes.load_scene(path, light, scenes.turned_up(axis))
        elif any(map(turntable_light.is_turntable, scene.emitters())):
            scene = scenes.load_scene(path, *read_environment(scene, []))
        pictures = _frames(scene, table, frames, size, spp, elevation, problem.max_depth, BACKGROUNDS[background])
        videos.write(place, pictures, rate)
    return place


def _check(frames: int, rate: float, size: int, spp: int, elevation: float, background: str) -> None:
    if not isinstance(frames, int) or not 1 <= frames <= _MOST_FRAMES:
        raise InputError(f"--frames {frames}: expected 1 to {_MOST_FRAMES}")
    if not 0 < rate <= 240:
        raise InputError(f"--rate {rate:g}: expected above 0 and at most 240")
    if not isinstance(size, int) or size % 2 or not 8 <= size <= _LARGEST:
        raise InputError(f"--size {size}: expected an even number from 8 to {_LARGEST}")
    if not isinstance(spp, int) or spp < 1:
        raise InputError(f"--spp {spp}: expected at least 1")
    if not -90 < elevation < 90:
        raise InputError(f"--elevation {elevation:g}: expected above -90 and below 90 degrees")
    if background not in BACKGROUNDS:
        raise InputError(f"--background {background}: expected {', '.join(BACKGROUNDS)}")


def _axis(up: Sequence[float]) -> np.ndarray:
    axis = np.array(up, float)
    if axis.shape != (3,) or not np.isfinite(axis).all() or not np.linalg.norm(axis) > 0:
        raise InputError(f"--up {up}: expected three numbers, not all 0")
    return axis / np.linalg.norm(axis)


def _table(scene: Any, up: np.ndarray, name: str) -> _Table:
    box = scene.bbox()
    low, high = np.array(box.min, float).ravel(), np.array(box.max, float).ravel()
    if not scene.shapes() or not np.isfinite([low, high]).all():
        raise InputError(f"{name}: nothing is in its scene that could be turned")
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    camera = np.array(scene.sensors()[0].world_transform().matrix, float).reshape(4, 4)[:3, 3]
    front = camera - middle
    for other in (front, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]):  # the first direction that is not parallel to the axis
        level = np.array(other) - np.dot(other, up) * up
        if np.linalg.norm(level) > 1e-3 * max(np.linalg.norm(other), 1e-9):
            return _Table(middle, radius, up, level / np.linalg.norm(level))
    raise AssertionError


def _frames(
    scene: Any, table: _Table, count: int, size: int, spp: int, elevation: float, max_depth: int, behind: float | None
) -> Iterator[np.ndarray]:
    """Yield the frames: camera and light move around the object, which is equivalent to a rotation of the object."""
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    lights = [each for each in scene.emitters() if each.class_name() == "EnvironmentMapEmitter"]
    parameters: list[Any] = [mi.traverse(light) for light in lights]
    at_first = [np.array(each["to_world"].matrix, float).reshape(4, 4) for each in parameters]
    camera, factor = table.camera(elevation), None
    with phases.phase("frames") as advance:
        for index in range(count):
            turn = table.turned(2 * np.pi * index / count)
            rotation = np.eye(4)
            rotation[:3, :3] = turn[:3, :3]
            for each, matrix in zip(parameters, at_first, strict=True):
                each["to_world"] = mi.Transform4f((rotation @ matrix).tolist())
                each.update()
            pose = mi.ScalarTransform4f((turn @ camera).tolist())
            clip = {"near_clip": 1e-3 * table.radius, "far_clip": 1e4 * table.radius}
            sensor = mi.load_dict({"type": "perspective", "fov": _ANGLE, "to_world": pose, "film": film, **clip})
            pixels = scenes.render(scene, sensor, spp, max_depth, index, behind is not None)
            colour, alpha = pixels[..., :3], np.clip(pixels[..., 3:], 0, 1)
            if factor is None:
                factor = exposure(colour if behind is None else colour[alpha[..., 0] > 0.5])
            shown = colour * factor + (0.0 if behind is None else (1 - alpha) * behind)
            yield (srgb(shown) * 255 + 0.5).astype(np.uint8)
            advance((index + 1) / count)
