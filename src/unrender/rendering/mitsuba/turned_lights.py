"""Distant lights that have another rotation for each sensor, such as the light of an object on a turntable.

Views of one scene that know other rotations of its lights are rendered by one launch: a ray's time selects the rotation. The sensor of
row i opens its shutter at time i, which all integrators support, including Mitsuba's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.film_response import is_spectral
from unrender.rendering.mitsuba.scene_graph import scene_of
from unrender.rendering.mitsuba.scene_loading import SceneDescription, load_sensors
from unrender.rendering.turns import Turns

_DISTANT = {"DirectionalEmitter", "EnvironmentMapEmitter"}  # classes of emitters that can be turned
_FAR = 1e4  # distance of the light for shadow rays, relative to the size of the scene


def turnable(scene: Any) -> tuple[str, ...]:
    """Return the ids of the lights that can have a rotation for each sensor; () if the scene does not support it."""
    sensors, emitters = scene.sensors(), [getattr(emitter, "light", emitter) for emitter in scene.emitters()]
    if is_spectral() or any(sensor.get_shape() is not None or sensor.shutter_open_time() > 0 for sensor in sensors):
        return ()
    ids = [emitter.id() for emitter in emitters]
    return tuple(
        e.id() for e in emitters if e.class_name() in _DISTANT and e.get_shape() is None and ids.count(e.id()) == 1
    )


def with_turns(scene: Any, turns: Turns | None, description: SceneDescription) -> Any:
    """Return the scene with its lights turned for each sensor; the scene itself for None. Its objects become part of the result."""
    if turns is None:
        return scene
    sensors = [*scene.sensors()]
    count = len(sensors)
    copies, more = list[Sequence[Any]](), load_sensors(description)
    for n, original in enumerate(turns.sensors[count:]):
        used = turns.sensors[count : count + n].count(original)
        copies += [next(more)] if used == len(copies) else []
        if (copied := copies[used][original]) in sensors:
            raise InputError(
                f"scene: sensor {copied.id() or original} is a ready-made Mitsuba object, which views that turn lights would share; "
                "give its dictionary, or a function that makes a new one each time"
            )
        sensors.append(copied)
    for row, sensor in enumerate(sensors):
        known: Any = mi.traverse(sensor)
        known["shutter_open"] = float(row)
        known.set_dirty("shutter_open")  # also if it was 0: a sensor that was never updated has a kernel of its own
        known.update()
    box = scene.bbox()
    size = float(dr.norm(box.extents())) if scene.shapes() and box.valid() else 1.0
    rotations = dict(turns.rotations)
    lights = [
        _turned(light, np.array(rotations[light.id()]), _FAR * size) if light.id() in rotations else light
        for light in scene.emitters()
        if light.get_shape() is None
    ]
    return scene_of([*scene.shapes(), *lights, *sensors])


def _turned(light: Any, vectors: np.ndarray, distance: float) -> Any:
    from scipy.spatial.transform import Rotation

    quaternions = np.roll(Rotation.from_rotvec(vectors).as_quat(), 1, axis=-1)
    return _emitter(mi.variant())(light, quaternions, distance)


def _rotated(table: Any, rows: int, vector: Any, time: Any, back: bool) -> Any:
    """Rotate a vector from the light's axes to the world's or, with `back`, the inverse. `table`: quaternions, `mi.Float` (4 * rows,)."""
    row = mi.UInt32(dr.clip(dr.round(mi.Float(time)), 0, rows - 1))
    w, x, y, z = (dr.gather(mi.Float, table, 4 * row + k) for k in range(4))
    axis: Any = mi.Vector3f(x, y, z)
    across: Any = 2 * dr.cross(axis, vector)
    return mi.Vector3f(vector + (-w if back else w) * across + dr.cross(axis, across))


@cache
def _emitter(variant: str) -> type:
    del variant  # a cache key only: the base class belongs to the active variant

    class TurnedLight(mi.Emitter):
        """A light that is evaluated with directions rotated to its axes."""

        def __init__(self, light: Any, quaternions: np.ndarray, distance: float):
            super().__init__(mi.Properties())
            self.light, self.rows, self.distance = light, len(quaternions), distance
            self.m_flags = light.flags()
            self.table = mi.Float(quaternions.astype(np.float32).ravel())
            dr.make_opaque(self.table)

        def traverse(self, callback: Any) -> None:
            super().traverse(callback)
            callback.put("light", self.light, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"TurnedLight[\n  turns = {self.rows},\n  light = {self.light}\n]"

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def _turn(self, vector: Any, time: Any, back: bool = False) -> Any:
            return _rotated(self.table, self.rows, vector, time, back)

        def eval(self, si: Any, active: Any = True) -> Any:
            local = mi.SurfaceInteraction3f(si)
            local.wi = self._turn(si.wi, si.time, back=True)
            return self.light.eval(local, active)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            ds, weight = self.light.sample_direction(it, sample, active)
            ds.d = self._turn(ds.d, it.time)
            ds.n, ds.dist = -ds.d, mi.Float(self.distance)
            ds.p = it.p + ds.d * ds.dist
            ds.emitter = mi.EmitterPtr(self)
            return ds, weight

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return self.light.pdf_direction(it, self._local(it, ds), active)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return self.light.eval_direction(it, self._local(it, ds), active)

        def _local(self, it: Any, ds: Any) -> Any:
            local = mi.DirectionSample3f(ds)
            local.d = self._turn(ds.d, it.time, back=True)
            return local

    return TurnedLight
