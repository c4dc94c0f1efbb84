"""Sensors and shapes that a recorded kernel supports, and emitters that must be prepared for it.

A recording captures an object's state through the members that its plugin declares to Dr.Jit. Mitsuba's thin lens, orthographic and
batch sensors do not declare all of theirs, so Dr.Jit refuses to record a kernel that samples their rays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.scene_graph import all_shapes
from unrender.rendering.renderer import SampleRequest

_COMPLETE = frozenset({"PerspectiveCamera", "DistantSensor", "DistantSensorImpl", "RadianceMeter", "IrradianceMeter"})
"""Sensor classes that declare all members in Mitsuba 3.9."""
_CURVES = frozenset({"BSplineCurve", "LinearCurve"})
"""Classes of curves."""
_MANY = 3
"""Number of sensors from which on a scene's sensors share recordings."""
_LONGEST_GAP = 32
"""Number of consecutive unused registry ids that ends a search. Ids of dead objects are reused."""


def are_recordable(sensor: Any, several: bool) -> bool:
    """Return whether a recording supports a `mitsuba.Sensor` or, with `several`, all sensors of the process.

    A virtual call sees every sensor of the process, including those of scenes that the caller has loaded. Unknown plugins are not
    supported.
    """
    sensors = _registered(mi.SensorPtr) if several else [sensor]  # pyright: ignore[reportAttributeAccessIssue]
    return all(each.class_name() in _COMPLETE for each in sensors)


def shapes_are_recordable(scene: Any) -> bool:
    """Return whether a recording supports all shapes of a `mitsuba.Scene`, those of shape groups included.

    Replays of kernels that hit curves may read memory out of bounds, and end the process with a segmentation fault.
    """
    return not any(shape.class_name() in _CURVES for shape in all_shapes(scene))


def for_every_sensor(request: SampleRequest, sensors: Sequence[mi.Sensor], count: int) -> SampleRequest:
    """Return a request in which each pixel has its own sensor, so that one recording serves all sensors of a scene.

    A scene of one or two sensors, or with a sensor that a recording does not support, keeps the request: random numbers depend on the scene
    alone, not on other scenes of the process.

    Args:
        count: number of pixels.
    """
    supported = all(sensor.class_name() in _COMPLETE for sensor in sensors)
    if request.sensors is not None or len(sensors) < _MANY or not supported:
        return request
    pixels = dr.arange(mi.UInt32, count) if request.pixels is None else request.pixels
    # A literal would be recorded as one, and the kernel once more at the second sensor.
    return replace(request, pixels=pixels, sensors=dr.opaque(mi.UInt32, request.sensor, count))


def build_emitter_tables() -> None:
    """Build the tables of textured area lights of all scenes in the process, since a recording cannot build them.

    A virtual call sees the emitters of every scene, including those that the caller has loaded and never rendered.
    """
    vertex: Any = dr.zeros(mi.SurfaceInteraction3f)
    for emitter in _registered(mi.EmitterPtr):
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying) and emitter.get_shape() is not None:
            with dr.suspend_grad():
                emitter.sample_direction(vertex, mi.Point2f(0.5), True)


def build_distributions(scene: Any) -> None:
    """Make textured emitters of a scene build the distributions of their texels, which they otherwise build at their first sample.

    A distribution that is built within a recorded kernel is not one of its inputs, and Dr.Jit refuses to record the kernel.
    """
    somewhere: Any = dr.zeros(mi.Interaction3f)
    for emitter in scene.emitters():
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying):
            dr.eval(emitter.sample_direction(somewhere, mi.Point2f(0.5)))


def _registered(kind: Any) -> Iterator[Any]:
    """Yield the objects of the process that pointers of a type can refer to."""
    number, missing = 1, 0
    while missing < _LONGEST_GAP:
        pointer: Any = dr.reinterpret_array(kind, mi.UInt32(number))
        try:
            registered = pointer[0]
        except RuntimeError:
            registered = None
        if registered is not None:  # an object has that id
            yield registered
        missing = 0 if registered is not None else missing + 1
        number += 1
