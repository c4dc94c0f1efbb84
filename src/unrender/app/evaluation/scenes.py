"""The result of a run as a scene of plain Mitsuba, under its own light or another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import mitsuba as mi
import numpy as np

from unrender.app.exporting.scene_folder import export
from unrender.app.stages import stages_file
from unrender.core.errors import InputError
from unrender.core.geometry import shortest_rotation
from unrender.io import images
from unrender.rendering.mitsuba.description import load
from unrender.scene.problem import Problem

HELD_OUT = "held-out.toml"


def find(run: Path, problem: Problem) -> Path:
    """Return held-out.toml beside the problem file of a run, or of its stages. Raises `InputError` if there is none."""
    staged = stages_file.stage_of(run)
    origin = problem.origin.get("file", problem.origin.get("scene")) if staged is None else staged[0].problem
    candidate = None if origin is None else Path(origin).parent / HELD_OUT
    if candidate is None or not candidate.is_file():
        where = "" if candidate is None else f" at {candidate}"
        raise InputError(
            f"{run}: no {HELD_OUT}{where}; give --held-out FILE, a problem file with other views (unrender import --hold-out N makes one)"
        )
    return candidate


LIGHT = "light"
_LEVEL = 0.3


def export_scene(problem: Problem, parameters: Mapping[str, np.ndarray], folder: Path) -> Path:
    """Export a result to a new folder and return its scene file. Raises `InputError` if plain Mitsuba cannot represent the scene."""
    scene = export((problem, parameters), folder).scene
    if scene is None:
        raise InputError(
            f"{problem.name}: the light of an emissive medium cannot be replaced; expected a scene of surfaces"
        )
    return scene


def read_light(path: Path) -> np.ndarray:
    """Read an environment map, (H, W, 3) linear. Raises `InputError` for a malformed or too small picture, or negative values."""
    try:
        values = images.read(path).values
    except InputError as error:
        raise InputError(f"--environment {error}") from error
    if min(values.shape[:2]) < 2 or values.min() < 0:
        raise InputError(f"--environment {path}: expected a picture of at least 2 x 2 texels, none below 0")
    return values


def load_scene(path: Path, light: np.ndarray | None = None, to_world: np.ndarray | None = None) -> Any:
    """Load a scene file of `export_scene`. An environment map (H, W, 3), rotated by `to_world` (3, 3), replaces all lights except emissive
    shapes; films then become RGB."""
    if light is None:
        return load(path)
    root = Xml.parse(path).getroot()
    for emitter in root.findall("emitter"):
        root.remove(emitter)
    for name in root.iterfind("sensor/film/string[@name='pixel_format']"):
        name.set("value", "rgb")
    file = path.parent / "other-light.exr"
    images.write(light, file)
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
    """Return the live sensors of the scene of a problem."""
    renderer: Any = problem.renderer
    return list(renderer.pair.current.sensors())


def up_axis(cameras: list[Any]) -> np.ndarray:
    """Return the up axis of the world, (3,) unit: the mean of the up axes of several cameras if they agree roughly, otherwise y."""
    axes = [np.array(sensor.world_transform().matrix, float).reshape(4, 4)[:3, 1] for sensor in cameras]
    mean = np.mean([axis / np.linalg.norm(axis) for axis in axes], 0)
    length = float(np.linalg.norm(mean))
    return mean / length if len(axes) > 1 and length > _LEVEL else np.array([0.0, 1.0, 0.0])


def turned_up(up: np.ndarray) -> np.ndarray:
    """Return the shortest rotation (3, 3) from y to an axis; the sky of environment maps is at y."""
    return shortest_rotation((0, 1, 0), up)


def render(scene: Any, sensor: Any, spp: int, max_depth: int, seed: int = 0, hide: bool = False) -> np.ndarray:
    """Render (H, W, C) float32 by Mitsuba's path tracer, unbiased up to `max_depth`; `hide` removes directly visible lights."""
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "hide_emitters": hide})
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=mi.UInt32(seed)), np.float32)
