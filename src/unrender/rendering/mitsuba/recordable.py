"""Sensors that a recorded kernel supports.

A recording captures an object's state through the members that its plugin declares to Dr.Jit. Mitsuba's thin lens, orthographic and
batch sensors do not declare all of theirs, so Dr.Jit refuses to record a kernel that samples their rays.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

_COMPLETE = frozenset({"PerspectiveCamera", "DistantSensor", "DistantSensorImpl", "RadianceMeter", "IrradianceMeter"})
"""Sensor classes that declare all members in Mitsuba 3.9."""
_LONGEST_GAP = 32
"""Number of consecutive unused registry ids that ends the search for sensors. Ids of dead objects are reused."""


def are_recordable(sensor: Any, several: bool) -> bool:
    """Return whether a recording supports a `mitsuba.Sensor` or, with `several`, all sensors of the process.

    A virtual call sees every sensor of the process, including those of scenes that the caller has loaded. Unknown plugins are not
    supported.
    """
    sensors = _registered() if several else [sensor]
    return all(each.class_name() in _COMPLETE for each in sensors)


def _registered() -> Iterator[Any]:
    """Yield the sensors of the process."""
    number, missing = 1, 0
    while missing < _LONGEST_GAP:
        pointer: Any = dr.reinterpret_array(mi.SensorPtr, mi.UInt32(number))  # pyright: ignore[reportAttributeAccessIssue]
        try:
            sensor = pointer[0]
        except RuntimeError:
            sensor = None
        if sensor is not None:  # an object has that id
            yield sensor
        missing = 0 if sensor is not None else missing + 1
        number += 1
