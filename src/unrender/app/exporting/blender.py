"""A Blender script that reproduces the appearance of an exported asset in Mitsuba: meshes, maps, light, cameras."""

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
# The y axis points up in glTF and Mitsuba, the z axis in Blender: its importer maps (x, y, z) to (x, -z, y).
_TO_BLENDER = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
# The map coordinate of a direction (x, y, z) is u = atan2(x, -z) / 2π in Mitsuba, and that of (x, -z, y) is u = 1/2 - atan2(-z, x) / 2π
# in Blender: a quarter more.
_QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def write(asset: Asset, folder: Path) -> None:
    """Write the script to the folder of asset.glb and environment.exr."""
    template = resources.files("unrender.app.exporting").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    text = json.dumps(settings(asset), indent=1, allow_nan=False)
    (folder / SCRIPT).write_text(template.replace(_PLACE, f"json.loads({text!r})"), encoding="utf-8")


def settings(asset: Asset) -> dict[str, Any]:
    """Return the settings of the script: cameras, with the matrices of Blender and lens shifts in units of the sensor width, and the
    rotation of directions before the look-up in the environment map."""
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
