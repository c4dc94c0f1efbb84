"""Which sensors a recorded kernel may hold.

A recording takes over what its objects hold through the members that their plugins name to Dr.Jit. Mitsuba's thin lens, orthographic and
batch sensors do not name all of theirs: Dr.Jit refuses to record a kernel that samples their rays.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

_COMPLETE = frozenset({"PerspectiveCamera", "DistantSensor", "DistantSensorImpl", "RadianceMeter", "IrradianceMeter"})
"""Classes that name all members, in Mitsuba 3.9."""
_LONGEST_GAP = 32
"""Unused registry ids in a row after which no further sensor is looked for. Ids of objects that died are used again."""


def are_recordable(sensor: Any, several: bool) -> bool:
    """Whether a recording may hold a `mitsuba.Sensor` or, with `several`, all sensors of the process.

    A call through a pointer sees every sensor of the process, those of scenes that the caller has loaded too. False for plugins that are
    not known.
    """
    found = _registered() if several else [sensor]
    return all(each.class_name() in _COMPLETE for each in found)


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
