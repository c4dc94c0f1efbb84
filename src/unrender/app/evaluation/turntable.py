"""A result turned around before a camera, under a light of the user's choice."""

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
"""Behind the object: what lights it, or a linear value."""
_ANGLE = 35.0
_MARGIN = 1.05
_MOST_FRAMES, _LARGEST = 10_000, 4096


@dataclass(frozen=True)
class _Table:
    """Where the camera stands: `middle` and `radius` of a ball around the object, `up`, and a horizontal direction to `front`."""

    middle: np.ndarray
    radius: float
    up: np.ndarray
    front: np.ndarray

    def camera(self, elevation: float) -> np.ndarray:
        """(4, 4), Mitsuba's `to_world`, at an elevation in degrees."""
        angle = np.radians(elevation)
        direction = np.cos(angle) * self.front + np.sin(angle) * self.up
        distance = _MARGIN * self.radius / np.sin(np.radians(_ANGLE / 2))
        origin = self.middle + distance * direction
        look = mi.ScalarTransform4f().look_at(origin.tolist(), self.middle.tolist(), self.up.tolist())
        return np.array(look.matrix, float).reshape(4, 4)

    def turned(self, angle: float) -> np.ndarray:
        """(4, 4), the world turned by an angle in radians about the axis through the middle."""
        found = np.eye(4)
        axis = np.array(self.up)
        k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        found[:3, :3] = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
        found[:3, 3] = self.middle - found[:3, :3] @ self.middle
        return found


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
    """A video of a run's result that turns once, before a camera and a light that stand still.

    All frames have one exposure, that of the first: of all of it, or of the object alone before a plain background.

    Args:
        run: a run folder.
        out: a name that ends in .mp4 (needs imageio-ffmpeg) or .gif, or a folder for PNG files.
        environment: a picture of light from all around, in place of the scene's lights; its upper edge is `up`.
        frames: >= 1.
        rate: frames a second, > 0.
        size: pixels a side, even.
        spp: samples per pixel.
        elevation: of the camera, in degrees above the horizon, in (-90, 90).
        up: the axis, (3,); None for the mean of the cameras' own, or y where there is one.
        background: "light", "black", "grey", "white".
        overwrite: whether what stands at `out` may be replaced.

    Returns:
        where it was written.

    Raises:
        InputError: no result, no surface, an option out of range, or `out` cannot be written; nothing is left then.
    """
    variant.ensure()
    place = Path(out)
    _check(frames, rate, size, spp, elevation, background)
    axis = None if up is None else _axis(up)
    videos.check(place, overwrite)
    light = None if environment is None else scenes.read_light(Path(environment))
    found = folders.read(run)
    problem = reopen.with_meshes(reopen.problem_of(run), found)
    with tempfile.TemporaryDirectory() as scratch:
        path = scenes.export_scene(problem, problem.full(found.parameters), Path(scratch) / "scene")
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
    for other in (front, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]):  # the first that is not along the axis
        level = np.array(other) - np.dot(other, up) * up
        if np.linalg.norm(level) > 1e-3 * max(np.linalg.norm(other), 1e-9):
            return _Table(middle, radius, up, level / np.linalg.norm(level))
    raise AssertionError


def _frames(
    scene: Any, table: _Table, count: int, size: int, spp: int, elevation: float, max_depth: int, behind: float | None
) -> Iterator[np.ndarray]:
    """The camera and the light go around the object, which is the object turning before them."""
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
