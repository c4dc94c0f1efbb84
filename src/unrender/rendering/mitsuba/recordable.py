"""Which sensors a recorded kernel may hold.

A recording takes over what its objects hold through the members that their plugins name to Dr.Jit. Mitsuba's thin lens, orthographic and
batch sensors do not name all of theirs: Dr.Jit refuses to record a kernel that samples their rays.
"""

from __future__ import annotations

from typing import Any

from unrender.rendering.mitsuba.loaded_scene import loaded_scenes

__all__ = ["are_recordable"]

_COMPLETE = frozenset({"PerspectiveCamera", "DistantSensor", "DistantSensorImpl", "RadianceMeter", "IrradianceMeter"})
"""Classes that name all members, in Mitsuba 3.9."""


def are_recordable(sensor: Any, several: bool) -> bool:
    """Whether a recording may hold a `mitsuba.Sensor` or, with `several`, all sensors of the process.

    A call through a pointer sees every sensor of the process. False for plugins that are not known.
    """
    found = [each for loaded in loaded_scenes() for each in loaded.scene.sensors()] if several else [sensor]
    return all(each.class_name() in _COMPLETE for each in found)
