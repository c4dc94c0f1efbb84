"""Functions of device arrays that are traced once, recorded, and replayed; what a recorded kernel supports, and what it needs.

A recording captures an object's state through the members that its plugin declares to Dr.Jit. Mitsuba's thin lens, orthographic and
batch sensors do not declare all of theirs, so Dr.Jit refuses to record a kernel that samples their rays.
"""

from __future__ import annotations

import functools
import gc
import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.scene_graph import all_shapes
from unrender.rendering.renderer import SampleRequest

_COMPLETE = frozenset({"PerspectiveCamera", "DistantSensor", "DistantSensorImpl", "RadianceMeter", "IrradianceMeter"})
"""Sensor classes that declare all members in Mitsuba 3.9."""
_CURVES = frozenset({"BSplineCurve", "LinearCurve"})  # classes of curves
_MANY = 3  # number of sensors from which on a scene's sensors share recordings
_LONGEST_GAP = 32  # Number of consecutive unused registry ids that ends a search. Ids of dead objects are reused.


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


_log = logging.getLogger("unrender")
_ATTEMPTS = 3  # number of consecutive failures after which a function is traced at every call
_INDEPENDENT = "the argument does not depend on the input variable"
"""Part of Dr.Jit's error message for a derivative that does not exist."""


class FrozenFunction:
    """A function that Dr.Jit records at its first call and replays at later ones. It is traced at each call if it cannot be recorded.

    A function may be called again after it failed. One that is not `recordable` is never recorded.

    A virtual call sees the objects of every scene in the process, including the caller's own. Some of them build tables at their first use,
    which cannot be recorded. Those of textured lights are built before the first recording. The traced call after a failure builds others,
    and scenes that are no longer used are freed. The next call therefore records again, up to three consecutive times.

    An error in a replay is raised, since out of memory, for example, does not justify tracing at every later call. Mitsuba objects outside
    the scenes that are passed in, even unused ones, can prevent Dr.Jit from recording.
    """

    def __init__(self, function: Callable[..., Any], recordable: bool = True, keys: Collection[str] = ()):
        self._function, self._keys = function, keys
        self._tracing = _Tracing()
        self._frozen: Callable[..., Any] | None = _recorder(function, self._tracing) if recordable else None
        self._recorded, self._failures = False, 0
        self._threads = dr.thread_count()

    def __call__(self, prepare: Callable[[], None], *arguments: Any) -> Any:
        """Return the function's result. `prepare` is called before each attempt, to undo the effects of a failed one."""
        prepare()
        if self._frozen is None:
            with _naming(self._keys):
                return self._function(*arguments)
        if dr.thread_count() != self._threads:
            # Recorded reductions have one slot per thread. A replay with more threads would write out of bounds.
            self._threads, self._recorded = dr.thread_count(), False
            self._frozen = _recorder(self._function, self._tracing)
        if not self._recorded:
            build_emitter_tables()
        self._tracing.happened = False
        try:
            with _without_garbage_collection():
                result = self._frozen(*arguments)
        except Exception as error:
            if self._recorded and not self._tracing.happened:
                raise
            prepare()
            with _naming(self._keys):
                result = self._function(*arguments)  # an error of the function itself propagates
            self._failures += 1
            gc.collect()  # objects of scenes that are no longer used may prevent recording until they are freed
            self._frozen = _recorder(self._function, self._tracing) if self._failures < _ATTEMPTS else None
            if self._frozen is None:
                _warn(str(_first_cause(error)).partition("\n")[0])
        else:
            self._failures = 0
        self._recorded = True
        return result


class _Tracing:
    """Flag whether a call has traced the function. It is a separate object, so recordings hold no reference cycle."""

    happened = False


def _recorder(function: Callable[..., Any], tracing: _Tracing) -> Callable[..., Any]:
    """Return the frozen function. A replay does not run it and leaves `tracing` unchanged."""

    def traced(*arguments: Any) -> Any:
        tracing.happened = True
        return function(*arguments)

    return dr.freeze(traced)


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Disable garbage collection: arrays that die during a recording abort the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def _naming(keys: Collection[str]) -> Iterator[None]:
    """Turn Dr.Jit's error about an image that depends on no parameter into an `InputError` that names the parameters."""
    try:
        yield
    except RuntimeError as error:
        if _INDEPENDENT not in str(_first_cause(error)):
            raise
        names = ", ".join(sorted(keys))
        raise InputError(
            f"parameter {names}: no derivative: at the initial values no picture depends on it, since another parameter, such as a weight "
            "of 0, hides it, or Mitsuba cannot differentiate by it; change that parameter, or use --method smoothed"
        ) from error


def _first_cause(error: BaseException) -> BaseException:
    while error.__cause__ is not None:
        error = error.__cause__
    return error


@functools.cache
def _warn(reason: str) -> None:
    _log.warning("a kernel could not be recorded and is traced at every call, which is slower: %s", reason)
