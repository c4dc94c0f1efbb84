"""Distant light whose direction varies between photographs: the Mitsuba plugin `turntable`.

    {"type": "turntable", "turns": "w x y z, w x y z, ...", "map": an envmap, constant or directional}

On a turntable the light is fixed and the object rotates. The scene's world frame is the object's, so the light rotates instead. A ray's
time selects the rotation: row i of `turns` (unit quaternions, from the map's axes to the world's) applies to times from i - 1/2 to i +
1/2. Sensors have i as `shutter_open` and `shutter_close`, which all integrators support, including Mitsuba's own. Times outside the
table use its first or last row. `distance`, 10^6 by default, is the light's distance for shadow rays. It must exceed the scene's size.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError

PLUGIN = "turntable"
_MAP, _TURNS = "map", "turns"
_MOST = 1 << 16
_FAR = 1e6


def register() -> None:
    """Register the plugin with the active variant. Repeated calls do nothing."""
    _plugin(mi.variant())


def is_turntable(emitter: Any) -> bool:
    """Return whether an emitter is of the `turntable` plugin."""
    return isinstance(emitter, _plugin(mi.variant()))


def text(rotations: np.ndarray) -> str:
    """Return rotations (N, 3, 3), from the map's axes to the world's, in the format of the plugin's `turns`."""
    from scipy.spatial.transform import Rotation

    quaternions = np.roll(Rotation.from_matrix(np.asarray(rotations, float)).as_quat(), 1, axis=-1)
    return ", ".join(" ".join(f"{x:.9g}" for x in row) for row in quaternions)


def turns(emitter: Any) -> np.ndarray:
    """Return the rotations of an emitter, (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(emitter.rows, -1, axis=-1)).as_matrix()


def _rows(properties: Any) -> np.ndarray:
    """Return the unit quaternions (N, 4) of the plugin's `turns`."""
    expected = f"emitter {PLUGIN}: {_TURNS}: expected 1 to {_MOST} rows of four numbers (w x y z), commas between them"
    value = properties.get(_TURNS, "")
    if not isinstance(value, str):
        raise InputError(expected)
    try:
        quaternions = np.array([[float(number) for number in row.split()] for row in value.split(",")], float)
    except ValueError as error:
        raise InputError(expected) from error
    if (
        quaternions.ndim != 2
        or quaternions.shape[1] != 4
        or not 1 <= len(quaternions) <= _MOST
        or not np.isfinite(quaternions).all()
    ):
        raise InputError(expected)
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not (length > 1e-6).all():
        raise InputError(expected)
    return quaternions / length


def _rotated(table: Any, rows: int, vector: Any, time: Any, back: bool) -> Any:
    """Rotate a vector from the map's axes to the world's or, with `back`, the inverse. `table`: quaternions, `mi.Float` (4 * rows,)."""
    row = mi.UInt32(dr.clip(dr.round(mi.Float(time)), 0, rows - 1))
    w, x, y, z = (dr.gather(mi.Float, table, 4 * row + k) for k in range(4))
    axis: Any = mi.Vector3f(x, y, z)
    across: Any = 2 * dr.cross(axis, vector)
    return mi.Vector3f(vector + (-w if back else w) * across + dr.cross(axis, across))


@cache
def _plugin(variant: str) -> type:
    del variant  # a cache key only: the base class belongs to the active variant

    class TurntableLight(mi.Emitter):
        """The emitter: `map` evaluated with directions that are rotated to its axes."""

        def __init__(self, properties: Any):
            super().__init__(properties)
            self.map = properties.get(_MAP, None)
            if not isinstance(self.map, mi.Emitter) or not mi.has_flag(self.map.flags(), mi.EmitterFlags.Infinite):
                raise InputError(
                    f"emitter {PLUGIN}: {_MAP} must be a distant emitter, such as an envmap or a directional"
                )
            self.rows = _rows(properties)
            self.m_flags = self.map.flags()
            self.table = mi.Float(self.rows.astype(np.float32).ravel())
            self.distance = float(properties.get("distance", _FAR))
            if not 0 < self.distance < np.inf:
                raise InputError(f"emitter {PLUGIN}: distance: expected a number above 0, got {self.distance:g}")
            dr.make_opaque(self.table)

        def traverse(self, callback: Any) -> None:
            super().traverse(callback)
            callback.put(_MAP, self.map, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"TurntableLight[\n  turns = {len(self.rows)},\n  map = {self.map}\n]"

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def _turned(self, vector: Any, time: Any, back: bool = False) -> Any:
            return _rotated(self.table, len(self.rows), vector, time, back)

        def eval(self, si: Any, active: Any = True) -> Any:
            local = mi.SurfaceInteraction3f(si)
            local.wi = self._turned(si.wi, si.time, back=True)
            return self.map.eval(local, active)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            ds, weight = self.map.sample_direction(it, sample, active)
            ds.d = self._turned(ds.d, it.time)
            ds.n, ds.dist = -ds.d, mi.Float(self.distance)
            ds.p = it.p + ds.d * ds.dist
            ds.emitter = mi.EmitterPtr(self)
            return ds, weight

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return self.map.pdf_direction(it, self._local(it, ds), active)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return self.map.eval_direction(it, self._local(it, ds), active)

        def _local(self, it: Any, ds: Any) -> Any:
            local = mi.DirectionSample3f(ds)
            local.d = self._turned(ds.d, it.time, back=True)
            return local

    mi.register_emitter(PLUGIN, TurntableLight)
    return TurntableLight
