"""Derivatives of images by the poses and fields of view of their sensors, and reasons why a sensor has none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet

import drjit as dr
import mitsuba as mi

from unrender.core.random import Key
from unrender.rendering.mitsuba.edges import EdgeTable
from unrender.rendering.mitsuba.film_response import is_spectral
from unrender.rendering.mitsuba.integrators.camera_motion import CameraMotion, SilhouetteCurves
from unrender.rendering.mitsuba.loaded_scene import LoadedScene
from unrender.rendering.mitsuba.parameters import ParameterTraits
from unrender.rendering.mitsuba.scene_graph import has_instances
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.rendering.mitsuba.view_weights import views_of
from unrender.rendering.renderer import ParameterInfo, SampleRequest

_STREAM = 4
"""Stream of a request's key, whose random numbers are independent of its paths and of its boundary samples."""
_LENSES = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
"""Mitsuba's lens parameters of a perspective sensor."""


def moved_sensor(scene: LoadedScene, key: str) -> str:
    """Return the id of the sensor that a parameter moves or whose lens it changes; "" if it is not a parameter of a sensor."""
    owner, _, name = key.rpartition(".")
    if key in scene.poses:
        owner = scene.poses.key(key).target
    elif name not in _LENSES:
        return ""
    return owner if any(sensor.id() == owner for sensor in scene.scene.sensors()) else ""


def moving_geometry(
    scene: LoadedScene, traits: Mapping[str, ParameterTraits], derivatives: AbstractSet[str]
) -> str | None:
    """Return the first parameter that moves geometry other than lights and sensors; None if there is none.

    A lens parameter without derivatives moves nothing, such as the aperture radius of a thin lens.
    """
    sensors = {sensor.id() for sensor in scene.scene.sensors()}
    for key, trait in traits.items():
        lens = key not in derivatives and key.rpartition(".")[0] in sensors
        if trait.geometric and not (trait.light or lens or moved_sensor(scene, key)):
            return key
    return None


def sensor_obstacle(pair: ScenePair, target: str) -> str:
    """Return the reason why there is no derivative by a sensor's parameters; "" if there is one."""
    if pair.volumetric or is_spectral():
        return f"path gradients of moving sensors do not support {'media' if pair.volumetric else 'spectral variants'}"
    kind = next(sensor.class_name() for sensor in pair.current.sensors() if sensor.id() == target)
    if kind != "PerspectiveCamera":
        return f"path gradients of sensors are limited to perspective sensors; {target} is another ({kind})"
    return ""


def translation_obstacle(pair: ScenePair) -> str:
    """Return the reason why there is no derivative by a sensor's position; "" if there is one."""
    if has_instances(pair.current):
        return "boundary derivatives do not support scenes with instances"
    if kinds := SilhouetteCurves.omitted(pair.current):
        return f"boundary derivatives do not support the silhouettes of {', '.join(kinds)}"
    return ""


def lens_parameters(pair: ScenePair) -> dict[str, ParameterInfo]:
    """Return {key: description} of the lens parameters of perspective sensors. Mitsuba marks these as not differentiable."""
    parameters = {}
    for index, sensor in enumerate(pair.current.sensors()):
        for name in _LENSES:
            key = f"{sensor.id()}.{name}"
            if key in pair.current_parameters and not sensor_obstacle(pair, sensor.id()):
                limits = pair.physical_range(key)
                reason = "it changes what the sensor sees"
                parameters[key] = ParameterInfo(
                    (), True, False, reason, limits.low, limits.high, viewpoint=True, sensor=index, nonlinear=True
                )
    return parameters


def no_tangents(keys: Iterable[str]) -> str:
    """Return the error message for adaptive pixel sampling with derivatives by sensor parameters only."""
    return (
        f"parameter {', '.join(sorted(keys))}: adaptive pixel sampling does not support derivatives by a sensor's parameters; "
        "use --method plain, or sample pixels uniformly (scheme = uniform)"
    )


class CameraTerm:
    """Derivatives with respect to sensor parameters, which are added to those of path replay with fixed camera rays.

    Args:
        pair: both loads of the scene.
        keys: keys of the parameters, all of sensors.
        max_depth: maximum path length in segments, >= 1.
        still: whether shapes do not move.
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
        """Add the derivatives of the mean over groups g of sum(weights[g] * image) to the gradients of the scene's leaves.

        It takes as many samples as the request, with independent random numbers, see `BoundaryTerm.accumulate`.
        """
        key = Key(request.seed, 0, _STREAM)
        for view in views_of(request, weights, self._resolutions):
            if view.sensor in self._motions:
                sensor = scene.scene.sensors()[view.sensor]
                motion = self._motions[view.sensor]
                image = motion.weighted_image(scene.scene, sensor, view, key.fold(view.sensor).uint32())
                if dr.grad_enabled(image):
                    dr.backward(image, dr.ADFlag.ClearInterior)
