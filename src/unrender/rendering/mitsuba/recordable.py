"""Which sensors a recorded kernel may hold.

A recording takes over what its objects hold through the members that their plugins name to Dr.Jit. Mitsuba's thin lens, orthographic and
batch sensors do not name all of theirs: Dr.Jit refuses to record a kernel that samples their rays.
"""

from __future__ import annotations

from typing import Any

__all__ = ["is_recordable"]

_COMPLETE = frozenset({"PerspectiveCamera", "DistantSensor", "DistantSensorImpl", "RadianceMeter", "IrradianceMeter"})
"""Classes that name all members, in Mitsuba 3.9."""


def is_recordable(sensor: Any) -> bool:
    """Whether a recording may hold a `mitsuba.Sensor`. False for plugins that are not known."""
    return sensor.class_name() in _COMPLETE
