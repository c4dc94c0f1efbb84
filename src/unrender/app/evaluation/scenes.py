"""A result as a scene of plain Mitsuba, under its own light or another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import mitsuba as mi
import numpy as np

from unrender.app.exporting import ready_made
from unrender.app.exporting.scene_folder import export
from unrender.app.stages import run_folders
from unrender.core.errors import InputError
from unrender.io import images
from unrender.rendering.mitsuba.description import load
from unrender.scene.problem import Problem

HELD_OUT = "held-out.toml"


def find(run: Path, problem: Problem) -> Path:
    """held-out.toml beside the problem file of a run, or beside that of the stages that it is one of. Raises `InputError`."""
    staged = run_folders.stage_of(run)
    origin = problem.origin.get("file", problem.origin.get("scene")) if staged is None else staged[0].problem
    beside = None if origin is None else Path(origin).parent / HELD_OUT
    if beside is None or not beside.is_file():
        where = "" if beside is None else f", and there is none at {beside}"
        raise InputError(f"{run}: give --held-out FILE, a problem file with other views{where}")
    return beside


LIGHT = "light"
_LEVEL = 0.3


def export_scene(problem: Problem, parameters: Mapping[str, np.ndarray], folder: Path) -> Path:
    """The scene file of a result, in a new folder. Raises `InputError` where plain Mitsuba has no such scene."""
    scene = export((problem, parameters), folder).scene
    if scene is None:
        raise InputError(f"{problem.name}: an emissive medium cannot be lit otherwise; expected a scene of surfaces")
    return scene


def read_light(path: Path) -> np.ndarray:
    """An environment map, (H, W, 3) linear. Raises `InputError`."""
    try:
        values = images.read(path).values
    except InputError as error:
        raise InputError(f"--environment {error}") from error
    if min(values.shape[:2]) < 2 or values.min() < 0:
        raise InputError(f"--environment {path}: expected a picture of at least 2 x 2 texels, none below 0")
    return values


def load_scene(path: Path, light: np.ndarray | None = None, to_world: np.ndarray | None = None) -> Any:
    """The scene of a file, live. Under another light, the sensors' shutters are as if never set: their times are the turntable's, and
    Mitsuba compiles a kernel for each.

    Args:
        path: of a scene that `export_scene` wrote.
        light: an environment map (H, W, 3) in place of all its lights but shapes that shine; None for its own.
        to_world: (3, 3) rotation of that map.
    """
    if light is None:
        return load(path)
    root = Xml.parse(path).getroot()
    for emitter in root.findall("emitter"):
        root.remove(emitter)
    for sensor in root.findall("sensor"):
        for name in ("shutter_open", "shutter_close"):
            for value in sensor.findall(f"float[@name='{name}']"):
                sensor.remove(value)
    file = path.parent / "other-light.exr"
    ready_made.write_bitmap(ready_made.as_bitmap(light), file)
    emitter = Xml.SubElement(root, "emitter", type="envmap", id=LIGHT)
    Xml.SubElement(emitter, "string", name="filename", value=str(file.absolute()))
    if to_world is not None:
        matrix = np.eye(4)
        matrix[:3, :3] = to_world
        transform = Xml.SubElement(emitter, "transform", name="to_world")
        Xml.SubElement(transform, "matrix", value=" ".join(map(repr, matrix.ravel().tolist())))
    lit = path.with_name("lit.xml")
    lit.write_bytes(Xml.tostring(root))
    return load(lit)


def sensors(problem: Problem) -> list[Any]:
    """The live sensors of a problem's scene."""
    renderer: Any = problem.renderer
    return list(renderer.pair.current.sensors())


def up_axis(given: list[Any]) -> np.ndarray:
    """Upwards in the world: the mean of several cameras' own up axes where they agree roughly, else y. (3,) unit."""
    axes = [np.array(sensor.world_transform().matrix, float).reshape(4, 4)[:3, 1] for sensor in given]
    mean = np.mean([axis / np.linalg.norm(axis) for axis in axes], 0)
    length = float(np.linalg.norm(mean))
    return mean / length if len(axes) > 1 and length > _LEVEL else np.array([0.0, 1.0, 0.0])


def turned_up(up: np.ndarray) -> np.ndarray:
    """The shortest rotation that takes y to an axis, (3, 3): environment maps have their sky at y."""
    y = np.array([0.0, 1.0, 0.0])
    axis, cosine = np.cross(y, up), float(up[1])
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + k + k @ k / (1 + cosine)


def render(scene: Any, sensor: Any, spp: int, max_depth: int, seed: int = 0, hide: bool = False) -> np.ndarray:
    """(H, W, C) float32 by Mitsuba's path tracer, unbiased up to `max_depth`; `hide`: without lights seen directly."""
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "hide_emitters": hide})
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=mi.UInt32(seed)), np.float32)
