"""Derivatives of pictures by the poses and fields of view of the sensors that took them; and where there are none."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from unrender.core.random import Key
from unrender.rendering.mitsuba.edges import EdgeTable
from unrender.rendering.mitsuba.integrators.camera_motion import CameraMotion
from unrender.rendering.mitsuba.loaded_scene import LoadedScene
from unrender.rendering.mitsuba.scene_graph import has_instances
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.rendering.mitsuba.view_weights import views_of
from unrender.rendering.renderer import ParameterInfo, SampleRequest

_STREAM = 4
"""Of the key of a request: numbers that neither its paths nor boundaries have."""
_LENSES = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
"""Mitsuba's own parameters of a perspective sensor."""


def moved_sensor(scene: LoadedScene, key: str) -> str:
    """The id of the sensor whose picture a parameter shifts, "" where it is no parameter of a sensor."""
    owner, _, name = key.rpartition(".")
    if key in scene.poses:
        owner = scene.poses.key(key).target
    elif name not in _LENSES:
        return ""
    return owner if any(sensor.id() == owner for sensor in scene.scene.sensors()) else ""


def sensor_obstacle(pair: ScenePair, target: str) -> str:
    """Why there is no derivative by a sensor's parameters, "" where there is."""
    if pair.volumetric:
        return "path gradients of moving sensors know no media"
    kind = next(sensor.class_name() for sensor in pair.current.sensors() if sensor.id() == target)
    if kind != "PerspectiveCamera":
        return f"path gradients move perspective sensors only, and {target} is another ({kind})"
    return ""


def translation_obstacle(pair: ScenePair) -> str:
    """Why there is no derivative by a sensor's position, "" where there is."""
    if has_instances(pair.current):
        return "boundary derivatives do not know the silhouettes of the scene's instances"
    return ""


def lens_parameters(pair: ScenePair) -> dict[str, ParameterInfo]:
    """{key: what the renderer says of it}: Mitsuba's own parameters of perspective sensors, which it marks as not differentiable."""
    found = {}
    for index, sensor in enumerate(pair.current.sensors()):
        for name in _LENSES:
            key = f"{sensor.id()}.{name}"
            if key in pair.current_parameters and not sensor_obstacle(pair, sensor.id()):
                limits = pair.physical_range(key)
                why = "it changes what the sensor sees"
                found[key] = ParameterInfo((), True, False, why, limits.low, limits.high, viewpoint=True, sensor=index)
    return found


def no_tangents(keys: Iterable[str]) -> str:
    """Return why pixels cannot be drawn by the variance of these derivatives, all by parameters of sensors."""
    return (
        f"parameter {', '.join(sorted(keys))}: adaptive pixels do not know how derivatives by a sensor vary: "
        "--method plain, or draw pixels uniformly (scheme = uniform)"
    )


class CameraTerm:
    """Derivatives with respect to the parameters of sensors, to be added to those of path replay, which holds the sensors' rays.

    Args:
        pair: both loads of the scene.
        keys: the parameters, of sensors all.
        max_depth: longest path in segments, >= 1.
        still: whether shapes stand still.
    """

    def __init__(self, pair: ScenePair, keys: Iterable[str], max_depth: int, still: bool):
        scene = pair.loaded()
        translating: dict[str, bool] = {}
        for key in keys:
            target = moved_sensor(scene, key)
            shifts = key in scene.poses and scene.poses.key(key).part == "translation"
            translating[target] = translating.get(target, False) or shifts
        table = EdgeTable(pair.current, set()) if any(translating.values()) else None
        self._motions = {
            index: CameraMotion(table if translating[sensor.id()] else None, max_depth, still)
            for index, sensor in enumerate(pair.current.sensors())
            if sensor.id() in translating
        }
        self._resolutions = pair.resolutions

    def accumulate(self, scene: LoadedScene, request: SampleRequest, weights: mi.TensorXf) -> None:
        """Add to the gradients of the scene's leaves those of the mean over groups g of sum(weights[g] * image), by as many samples as
        the request has, of numbers of its own. See `BoundaryTerm.accumulate`."""
        key = Key(request.seed, 0, _STREAM)
        for view in views_of(request, weights, self._resolutions):
            if view.sensor in self._motions:
                sensor = scene.scene.sensors()[view.sensor]
                motion = self._motions[view.sensor]
                found = motion.weighted_image(scene.scene, sensor, view, key.fold(view.sensor).uint32())
                if dr.grad_enabled(found):
                    dr.backward(found, dr.ADFlag.ClearInterior)
