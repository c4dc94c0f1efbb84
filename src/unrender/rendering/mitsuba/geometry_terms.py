"""Terms of path gradients for moving geometry: boundaries of moving meshes, and sensors; and reasons why a shape or sensor has none."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.rendering.mitsuba.edges import EdgeTable
from unrender.rendering.mitsuba.film import ViewWeights, views_of
from unrender.rendering.mitsuba.film_response import is_spectral
from unrender.rendering.mitsuba.integrators.aov import AovKernel
from unrender.rendering.mitsuba.integrators.boundary import BoundaryIntegrator
from unrender.rendering.mitsuba.integrators.camera_motion import CameraMotion, SilhouetteCurves
from unrender.rendering.mitsuba.light_paths import LightPaths
from unrender.rendering.mitsuba.loaded_scene import LoadedScene
from unrender.rendering.mitsuba.mesh_layout import POSITIONS
from unrender.rendering.mitsuba.parameters import MOVED_MIRROR, ParameterTraits, is_mirror_or_glass
from unrender.rendering.mitsuba.pixel_filter import is_box
from unrender.rendering.mitsuba.poses import is_bare
from unrender.rendering.mitsuba.scene_graph import has_instances
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.rendering.renderer import ParameterInfo, SampleRequest

_STREAM = 3  # stream of a request's key, whose random numbers are independent of its paths


def moved_shape(scene: LoadedScene, key: str) -> str:
    """Return the id of the shape whose points a parameter moves; "" if it moves none."""
    if key in scene.poses:
        target = scene.poses.key(key).target
        return "" if is_bare(scene.scene, target) else target
    owner, _, name = key.rpartition(".")
    return owner if name == POSITIONS else ""


def obstacles(pair: ScenePair, targets: Iterable[str], aov: str = "") -> dict[str, str]:
    """Return {target: reason why a moving shape has no boundary derivative, "" if it has one}: of radiance, or of an AOV, in which masks
    and glass are as any surface."""
    shapes = {shape.id(): shape for shape in pair.current.shapes()}
    return {target: _obstacle(pair, target, shapes.get(target), aov) for target in targets}


def _obstacle(pair: ScenePair, target: str, shape: Any, aov: str) -> str:
    if pair.volumetric:
        return "path gradients of moving shapes do not support media"
    if is_spectral():
        return "path gradients of moving shapes do not support spectral variants"
    if any(sensor.film().sample_border() and not is_box(sensor.film()) for sensor in pair.current.sensors()):
        return "path gradients of moving shapes do not support sample_border: leave it out of the film"
    if not aov and (reason := _masks_obstacle(pair)):
        return reason
    if shape is None:
        return "path gradients do not support moving instances"
    if has_instances(pair.current):
        return "boundary derivatives do not support scenes with instances"
    known = pair.current_parameters
    if not shape.is_mesh() or not any(f"{target}.{name}" in known for name in (POSITIONS, "to_world")):
        return f"{target} is not a mesh ({shape.class_name()}); boundary derivatives are limited to meshes"
    if not aov and is_mirror_or_glass(shape.bsdf()):
        return MOVED_MIRROR
    kinds = [sensor.class_name() for sensor in pair.current.sensors()]
    if "PerspectiveCamera" not in kinds:
        return f"boundary derivatives are limited to perspective sensors; the scene has none ({', '.join(kinds)})"
    return ""


def _masks_obstacle(pair: ScenePair) -> str:
    """Return the reason why a scene whose surfaces let light pass straight on has no boundary derivative; "" for others. Edges behind
    these are omitted, and `prb` loses the motion of the light that passes them."""
    for shape in pair.current.shapes():
        bsdf = shape.bsdf()
        if bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null):
            return f"boundary derivatives do not support opacity masks, thin glass and null surfaces ({shape.id()})"
    return ""


class BoundaryTerm:
    """Boundary derivatives with respect to parameters that move meshes, which are added to those of path replay."""

    def __init__(self, pair: ScenePair, moving: Iterable[str], paths: LightPaths):
        scene = pair.loaded()
        loaded = {
            mesh.id(): np.array(scene.value(f"{mesh.id()}.{POSITIONS}"))
            for mesh in pair.current.shapes()
            if mesh.is_mesh() and f"{mesh.id()}.{POSITIONS}" in scene.parameters
        }
        aov = AovKernel(paths.aov) if paths.aov else None
        self._integrator = BoundaryIntegrator(EdgeTable(pair.current, set(moving), loaded), paths.max_depth, aov)
        self._resolutions = pair.resolutions

    def accumulate(self, scene: LoadedScene, request: SampleRequest, weights: mi.TensorXf) -> None:
        """Add the boundary term of the mean over groups g of sum(weights[g] * image) to the gradients of the leaves of a scene with
        attached parameters.

        It takes as many samples as the request, rounded up to a power of two if the request chooses pixels. Their random numbers are
        independent of those of the rendering.
        """
        for view in views_of(request, weights, self._resolutions):
            sensor, seed, samples = self._samples(scene, request, view)
            image = self._integrator.weighted_image(scene.scene, sensor, view.image, seed, samples)
            if dr.grad_enabled(image):
                dr.backward(image, dr.ADFlag.ClearInterior)

    def tangent_moment(
        self, scene: LoadedScene, request: SampleRequest, combined: tuple[float, ...] | None = None
    ) -> mi.TensorXf:
        """Return the squared boundary derivative of each pixel of a request along the tangents of the scene, (N, 3): of each channel, or of
        the sum with the weights `combined`. It takes as many samples as `accumulate`. Their noise is part of the second moment, as it is of
        the gradient."""
        count = math.prod(self._resolutions[request.sensor]) if request.pixels is None else dr.width(request.pixels)
        moments = dr.zeros(mi.Float, 3 * count)
        zeros = dr.zeros(mi.TensorXf, (1, count, 3))
        for view in views_of(request, zeros, self._resolutions):
            sensor, seed, samples = self._samples(scene, request, view)
            image = self._integrator.tangent_image(scene.scene, sensor, seed, samples)
            element = dr.arange(mi.UInt32, 3 * dr.width(view.pixels))
            channel = element % 3
            of_pixel = dr.gather(mi.UInt32, view.pixels, element // 3) * 3 + channel
            into = dr.gather(mi.UInt32, view.rows, element // 3) * 3 + channel
            if combined is None:
                derivative = dr.gather(mi.Float, image.array, of_pixel)
            else:
                parts = [w * dr.gather(mi.Float, image.array, of_pixel - channel + c) for c, w in enumerate(combined)]
                derivative = sum(parts[1:], parts[0])
            dr.scatter(moments, dr.square(derivative), into)
        return mi.TensorXf(moments, (count, 3))

    @staticmethod
    def _samples(scene: LoadedScene, request: SampleRequest, view: ViewWeights) -> tuple[mi.Sensor, int, int]:
        sensor = scene.scene.sensors()[view.sensor]
        if sensor.class_name() != "PerspectiveCamera":
            raise InputError(
                f"sensor {sensor.id()}: path gradients of moving shapes are limited to perspective sensors, got "
                f"{sensor.class_name()}; use --method smoothed"
            )
        # The number of a view's pixels in a mini-batch varies between steps, and each size needs its own kernel recording.
        samples = view.samples if request.pixels is None else 1 << (view.samples - 1).bit_length()
        return sensor, Key(request.seed, 0, _STREAM).fold(view.sensor).uint32(), samples


_CAMERA_STREAM = 4
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
    return _masks_obstacle(pair)


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
    """Derivatives with respect to sensor parameters, which are added to those of path replay with fixed camera rays. Shapes may be
    `still`."""

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
        key = Key(request.seed, 0, _CAMERA_STREAM)
        for view in views_of(request, weights, self._resolutions):
            if view.sensor in self._motions:
                sensor = scene.scene.sensors()[view.sensor]
                motion = self._motions[view.sensor]
                image = motion.weighted_image(scene.scene, sensor, view, key.fold(view.sensor).uint32())
                if dr.grad_enabled(image):
                    dr.backward(image, dr.ADFlag.ClearInterior)
