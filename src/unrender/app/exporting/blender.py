"""A script that opens an exported asset in Blender as Mitsuba shows it: mesh, maps, light, cameras."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from unrender.app.exporting.asset import Asset, Camera
from unrender.rendering.camera_axes import MITSUBA_TO_OPENGL

SCRIPT = "open_in_blender.py"
_TEMPLATE, _PLACE = "open_in_blender.py.txt", '"SETTINGS"'
# glTF's and Mitsuba's y is up, Blender's z is: its importer takes (x, y, z) to (x, -z, y).
_TO_BLENDER = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
# Mitsuba looks a direction (x, y, z) up at u = atan2(x, -z) / 2π, Blender (x, -z, y) at u = 1/2 - atan2(-z, x) / 2π: a quarter more.
_QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def write(asset: Asset, folder: Path) -> None:
    """Write the script beside asset.glb and environment.exr."""
    template = resources.files("unrender.app.exporting").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    text = json.dumps(settings(asset), indent=1, allow_nan=False)
    (folder / SCRIPT).write_text(template.replace(_PLACE, f"json.loads({text!r})"), encoding="utf-8")


def settings(asset: Asset) -> dict[str, Any]:
    """What the script sets: cameras with Blender's matrices, lens shifts in widths, and the rotation of directions before the light's
    picture is looked up."""
    to_light = _QUARTER @ _TO_BLENDER @ np.linalg.inv(asset.environment_to_world) @ _TO_BLENDER.T
    return {
        "environment": None if asset.environment is None else "environment.exr",
        "environment_rotation": to_light.tolist(),
        "cameras": [_camera(camera) for camera in asset.cameras],
    }


def _camera(camera: Camera) -> dict[str, Any]:
    turned = np.eye(4)
    turned[:3, :3] = _TO_BLENDER
    width, height = camera.size
    return {
        "name": camera.name,
        "matrix": (turned @ camera.to_world @ MITSUBA_TO_OPENGL).tolist(),
        "angle_x": float(np.radians(camera.x_fov)),
        "shift": [camera.offset[0], -camera.offset[1] * height / width],
        "size": [width, height],
        "clip": list(camera.clip),
    }
