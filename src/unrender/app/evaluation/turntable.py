"""A turntable video of a result under a selected light, as .mp4, .gif, or a folder of PNG files."""

from __future__ import annotations

import importlib.util
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

from unrender.app.evaluation import scenes
from unrender.backend import variant
from unrender.core import checks, phases
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.geometry import rotation
from unrender.core.text import in_words, printable
from unrender.display.pictures import quantized
from unrender.io import files
from unrender.losses.metrics import exposure, srgb
from unrender.runs import reopen
from unrender.runs.folder import reader as folders
from unrender.scene.problem import Problem

BACKGROUNDS = {"light": None, "black": 0.0, "grey": 0.18, "white": 1.0}
"""Backgrounds of the object: the light itself (None), or a linear value."""
_ANGLE = 35.0
_MARGIN = 1.05
_MOST_FRAMES, _LARGEST = 10_000, 4096
_STANDING = {"EnvironmentMapEmitter", "ConstantBackgroundEmitter"}  # emitters whose light does not turn with the object


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
        transform[:3, :3] = rotation(self.up, angle)
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
    notify: Callable[[str], None] | None = None,
) -> Path:
    """Render a video of one rotation of the result of a run in front of a fixed camera under a fixed light.

    All frames have the exposure of the first frame; with a plain background, that of the object alone.

    Args:
        run: a run folder.
        out: a name that ends in .mp4 (needs imageio-ffmpeg) or .gif (frames of whole hundredths of a second), or a folder for PNG files.
        environment: an environment map that replaces the lights of the scene; its upper edge is `up`.
        frames: number of frames, >= 1.
        rate: frames per second, > 0.
        size: width and height in pixels, even.
        spp: samples per pixel.
        elevation: elevation of the camera in degrees above the horizon, in (-90, 90).
        up: the axis, (3,); None for the mean of the cameras' up axes, or y for a single camera.
        background: "light", "black", "grey", "white".
        overwrite: whether existing files at `out` may be replaced.
        notify: called with each notice, one line.

    Returns:
        The path of the video.

    Raises:
        InputError: no result, no surface, an option out of range, or `out` cannot be written. No files remain after an error.
    """
    variant.ensure()
    place = checks.path("turntable: out", out, "a file")
    _check(frames, rate, size, spp, elevation, background)
    axis = None if up is None else _axis(up)
    check_video(place, overwrite, rate)
    light = None if environment is None else scenes.read_light(Path(environment))
    problem, result = _opened(run, notify)
    with tempfile.TemporaryDirectory() as scratch:
        path = scenes.export_scene(problem, problem.full(result.parameters), Path(scratch) / "scene")
        scene = scenes.load_scene(path)
        axis = scenes.up_axis(list(scene.sensors())) if axis is None else axis
        table = _table(scene, axis, problem.name)
        if light is not None:
            scene = scenes.load_scene(path, light, scenes.turned_up(axis))
        if notify is not None and (turning := sorted({each.class_name() for each in scene.emitters()} - _STANDING)):
            notify(f"{', '.join(turning)}: turns with the scene; only environment maps stand still, see --environment")
        pictures = _frames(scene, table, frames, size, spp, elevation, problem.max_depth, BACKGROUNDS[background])
        write_video(place, pictures, rate)
    return place


def _opened(run: str | Path, notify: Callable[[str], None] | None) -> tuple[Problem, folders.RunFolder]:
    """Return the problem of a run folder with its final meshes, and the folder's contents."""
    result, problem = folders.read(run), reopen.problem_of(run)
    for line in reopen.scene_changes(problem, result):
        if notify is not None:
            notify(line)
    return reopen.with_meshes(problem, result), result


def _check(frames: int, rate: float, size: int, spp: int, elevation: float, background: str) -> None:
    if not isinstance(frames, int) or not 1 <= frames <= _MOST_FRAMES:
        raise InputError(f"--frames {in_words(frames)}: expected 1 to {_MOST_FRAMES}")
    if not 0 < checks.real(rate) <= 240:
        raise InputError(f"--rate {in_words(rate).removesuffix('.0')}: expected above 0 and at most 240")
    if not isinstance(size, int) or size % 2 or not 8 <= size <= _LARGEST:
        raise InputError(f"--size {in_words(size)}: expected an even number from 8 to {_LARGEST}")
    checks.integer("turntable", "spp", spp, at_least=1)
    if not -90 < checks.real(elevation) < 90:
        raise InputError(
            f"--elevation {in_words(elevation).removesuffix('.0')}: expected above -90 and below 90 degrees"
        )
    if not isinstance(background, str) or background not in BACKGROUNDS:
        raise InputError(f"--background {printable(background)}: expected {', '.join(BACKGROUNDS)}")


def _axis(up: Sequence[float]) -> np.ndarray:
    try:
        axis = np.array(up, float)
    except (TypeError, ValueError, OverflowError):
        axis = np.zeros(0)
    if axis.shape != (3,) or not np.isfinite(axis).all() or not np.linalg.norm(axis) > 0:
        raise InputError(f"--up {in_words(up)}: expected three numbers, not all 0")
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
            yield quantized(srgb(shown))
            advance((index + 1) / count)


ENDINGS = (".mp4", ".gif", "")
"""Supported file name extensions; "" is a folder."""
_QUALITY = 8


def has_ffmpeg() -> bool:
    """Return whether .mp4 files can be written."""
    return importlib.util.find_spec("imageio_ffmpeg") is not None


def check_video(path: Path, overwrite: bool, rate: float) -> None:
    """Raise `InputError` if a video cannot be written to `path`, or cannot have the rate."""
    if path.suffix.lower() == ".gif":
        _hundredths(rate)
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"--out {path}: expected a name that ends in .mp4 or .gif, or the name of a folder")
    if path.suffix.lower() == ".mp4" and not has_ffmpeg():
        raise InputError(f"--out {path}: .mp4 needs imageio-ffmpeg: pip install 'unrender[capture]'; .gif does not")
    with files.input_errors(f"--out {path}"):
        if path.is_dir() and path.suffix:
            raise InputError(f"--out {path}: a folder, expected a file's name")
        if path.is_dir() and any(each.suffix != ".png" or not each.stem.isdigit() for each in path.iterdir()):
            raise InputError(f"--out {path}: the folder contains other files; give a new folder")
        if path.is_file() and not path.suffix:
            raise InputError(f"--out {path}: a file, expected a folder's name")
        if (path.is_file() or (path.is_dir() and any(path.iterdir()))) and not overwrite:
            raise InputError(f"--out {path}: exists; give --overwrite to replace it")
        there = next(each for each in (path.parent, *path.absolute().parents) if each.exists())
        if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
            raise InputError(f"--out {path}: {there} is not a folder that can be written to")


def write_video(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    """Write frames (H, W, 3), bytes of even sizes, at `rate` per second, as they arrive. Raises `InputError` if that fails."""
    ending = path.suffix.lower()
    if not ending:
        files.remove_leftovers(path.parent, (path.name,))
        files.write_folder(path, lambda folder: _write_frames(folder, frames), f"--out {path}")
        return
    with files.input_errors(f"--out {path}"), tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / f"video{ending}"
        (_write_gif if ending == ".gif" else _write_mp4)(file, frames, rate)
        files.write(path, file.read_bytes())


def _write_frames(folder: Path, frames: Iterable[np.ndarray]) -> None:
    for index, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"{index:04d}.png")


def _hundredths(rate: float) -> int:
    """Return the time of a frame in a .gif. Raise `InputError` for a rate that its files or browsers do not have."""
    if not 0.002 <= rate <= 50:
        raise InputError(
            f"--rate {rate:g}: expected 0.002 to 50 frames per second for a .gif; write an .mp4 for others"
        )
    return round(100 / rate)


def _write_gif(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    pictures = [Image.fromarray(frame).quantize(256) for frame in frames]
    time = 10 * _hundredths(rate)
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=time, loop=0)


def _write_mp4(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    import imageio_ffmpeg

    write_frames: Any = imageio_ffmpeg.write_frames
    sink = None
    try:
        for frame in frames:
            if sink is None:
                size = frame.shape[1], frame.shape[0]
                sink = write_frames(
                    str(path), size, fps=rate, quality=_QUALITY, macro_block_size=2, ffmpeg_log_level="error"
                )
                sink.send(None)
            sink.send(np.ascontiguousarray(frame))
    finally:
        if sink is not None:
            sink.close()
