"""The boundary part of path gradients, for the parameters that move meshes; and where there is none."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.random import Key
from unrender.rendering.mitsuba.edges import EdgeTable
from unrender.rendering.mitsuba.integrators.boundary import BoundaryIntegrator
from unrender.rendering.mitsuba.loaded_scene import LoadedScene
from unrender.rendering.mitsuba.scene_pair import ScenePair
from unrender.rendering.renderer import SampleRequest

__all__ = ["BoundaryTerm", "moved_shape", "obstacles"]

_STREAM = 3
"""Of the key of a request: numbers that its paths do not have."""


def moved_shape(scene: LoadedScene, key: str) -> str:
    """The id of the shape whose points a parameter moves, "" where it moves none."""
    if key in scene.poses:
        return scene.poses.key(key).target
    owner, _, name = key.rpartition(".")
    return owner if name == "vertex_positions" else ""


def obstacles(pair: ScenePair, targets: Iterable[str]) -> dict[str, str]:
    """{target: why there is no boundary derivative of a moving shape, "" where there is}."""
    shapes = {shape.id(): shape for shape in pair.current.shapes()}
    return {target: _obstacle(pair, target, shapes.get(target)) for target in targets}


def _obstacle(pair: ScenePair, target: str, shape: Any) -> str:
    if pair.volumetric:
        return "path gradients of moving shapes know no media"
    if any(sensor.id() == target for sensor in pair.current.sensors()):
        return "path gradients do not move sensors"
    if shape is None:
        return "path gradients do not move instances"
    if not shape.is_mesh():
        return f"{target} is no mesh ({shape.class_name()}), which boundary derivatives are limited to"
    if shape.is_emitter():
        return "path gradients do not move emitters"
    for sensor in pair.current.sensors():
        kind = sensor.class_name()
        if kind != "PerspectiveCamera":
            return f"boundary derivatives are limited to perspective sensors, and {sensor.id()} is another ({kind})"
    return ""


class BoundaryTerm:
    """Boundary derivatives with respect to parameters that move meshes, to be added to those of path replay.

    Args:
        pair: both loads of the scene.
        moving: ids of the shapes that move.
        max_depth: longest path in segments, >= 1.
    """

    def __init__(self, pair: ScenePair, moving: Iterable[str], max_depth: int):
        scene = pair.loaded()
        loaded = {
            mesh.id(): np.array(scene.value(f"{mesh.id()}.vertex_positions"))
            for mesh in pair.current.shapes()
            if mesh.is_mesh() and f"{mesh.id()}.vertex_positions" in scene.parameters
        }
        self._integrator = BoundaryIntegrator(EdgeTable(pair.current, set(moving), loaded), max_depth)
        self._resolutions = pair.resolutions

    def accumulate(self, scene: LoadedScene, request: SampleRequest, weights: mi.TensorXf) -> None:
        """Add to the gradients of the scene's leaves those of the mean over groups g of sum(weights[g] * image), by as many samples as
        the request has, of numbers of its own.

        Args:
            scene: its parameters are set and attached.
            request: of the rendering; the boundary's numbers are independent of its own.
            weights: of `RenderSession.adjoint`.
        """
        key = Key(request.seed, 0, _STREAM)
        for sensor, image in self._images(request, weights):
            height, width = self._resolutions[sensor]
            pixels = height * width if request.pixels is None else dr.width(request.pixels)
            found = self._integrator.weighted_image(
                scene.scene, scene.scene.sensors()[sensor], image, key.fold(sensor).uint32(), pixels * request.spp
            )
            if dr.grad_enabled(found):
                dr.backward(found, dr.ADFlag.ClearInterior)

    def _images(self, request: SampleRequest, weights: mi.TensorXf) -> list[tuple[int, mi.TensorXf]]:
        """(sensor, mean weights (H, W, 3)) of all that have pixels."""
        groups = weights.shape[0]
        size = dr.width(weights.array) // groups
        lane = dr.arange(mi.UInt32, size)
        mean = mi.Float(0)
        for group in range(groups):
            mean += dr.gather(mi.Float, weights.array, lane + group * size)
        mean /= groups
        dr.eval(mean)
        if request.pixels is None:
            return [(request.sensor, mi.TensorXf(mean, (*self._resolutions[request.sensor], 3)))]
        which = np.full(size // 3, request.sensor) if request.sensors is None else np.array(request.sensors)
        found = []
        for sensor in np.unique(which).tolist():
            height, width = self._resolutions[sensor]
            image = dr.zeros(mi.Float, height * width * 3)
            pixel = dr.gather(mi.UInt32, request.pixels, lane // 3)
            own = mi.Bool(True)
            if request.sensors is not None:
                own = dr.gather(mi.UInt32, mi.UInt32(request.sensors), lane // 3) == sensor
            dr.scatter_add(image, mean, pixel * 3 + lane % 3, own)
            found.append((int(sensor), mi.TensorXf(image, (height, width, 3))))
        return found
