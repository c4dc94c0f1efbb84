"""Light from afar whose direction is another in each photograph: Mitsuba's plugin `turntable`.

    {"type": "turntable", "turns": "w x y z, w x y z, ...", "map": an envmap, constant or directional}

On a turntable the light stands still and the object turns. The scene's world is the object's, so it is the light that turns. A ray's time
says how far: light of row i of `turns` (unit quaternions, from the map's axes to the world's) reaches rays of times i - 1/2 to i + 1/2.
Sensors have i as `shutter_open` and `shutter_close`, which all integrators carry along, Mitsuba's own, too. Times outside of the table have
its first or last row. `distance`, 10^6 where it is not given, is how far away the light is for shadows: larger than the scene.
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
    """Make the plugin known to the variant that is set. Again does nothing."""
    _plugin(mi.variant())


def is_turntable(emitter: Any) -> bool:
    """Whether an emitter is such a one."""
    return isinstance(emitter, _plugin(mi.variant()))


def text(rotations: np.ndarray) -> str:
    """Rotations (N, 3, 3), from the map's axes to the world's, as the plugin's `turns`."""
    from scipy.spatial.transform import Rotation

    quaternions = np.roll(Rotation.from_matrix(np.asarray(rotations, float)).as_quat(), 1, axis=-1)
    return ", ".join(" ".join(f"{x:.9g}" for x in row) for row in quaternions)


def turns(emitter: Any) -> np.ndarray:
    """The rotations of a live emitter, (N, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(emitter.rows, -1, axis=-1)).as_matrix()


def _rows(properties: Any) -> np.ndarray:
    """(N, 4) unit quaternions."""
    expected = f"emitter {PLUGIN}: {_TURNS}: expected 1 to {_MOST} rows of four numbers (w x y z), commas between them"
    given = properties.get(_TURNS, "")
    if not isinstance(given, str):
        raise InputError(expected)
    try:
        found = np.array([[float(number) for number in row.split()] for row in given.split(",")], float)
    except ValueError as error:
        raise InputError(expected) from error
    if found.ndim != 2 or found.shape[1] != 4 or not 1 <= len(found) <= _MOST or not np.isfinite(found).all():
        raise InputError(expected)
    length = np.linalg.norm(found, axis=1, keepdims=True)
    if not (length > 1e-6).all():
        raise InputError(expected)
    return found / length


def _rotated(table: Any, rows: int, vector: Any, time: Any, back: bool) -> Any:
    """A vector of the map's axes in the world's; `back`: of the world's in the map's. `table`: quaternions, `mi.Float` (4 * rows,)."""
    row = mi.UInt32(dr.clip(dr.round(mi.Float(time)), 0, rows - 1))
    w, x, y, z = (dr.gather(mi.Float, table, 4 * row + k) for k in range(4))
    axis: Any = mi.Vector3f(x, y, z)
    across: Any = 2 * dr.cross(axis, vector)
    return mi.Vector3f(vector + (-w if back else w) * across + dr.cross(axis, across))


@cache
def _plugin(variant: str) -> type:
    del variant  # the base class is that of the variant that is set

    class TurntableLight(mi.Emitter):
        """Directions are turned into the map's axes, and back."""

        def __init__(self, properties: Any):
            super().__init__(properties)
            self.map = properties.get(_MAP, None)
            if not isinstance(self.map, mi.Emitter) or not mi.has_flag(self.map.flags(), mi.EmitterFlags.Infinite):
                raise InputError(
                    f"emitter {PLUGIN}: {_MAP} must be light from afar, such as an envmap or a directional"
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
