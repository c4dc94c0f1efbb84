"""Maps from objects of the current scene to those of the previous one, by gathers from registry id to registry id."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.integrators.array_types import UInt32

Pointer = TypeVar("Pointer", "mi.BSDFPtr", "mi.EmitterPtr", "mi.ShapePtr", "mi.MediumPtr")


def registry_id(pointer: Any) -> UInt32:
    """Return the registry id of each lane's object, 0 for none."""
    return dr.reinterpret_array(mi.UInt32, pointer)


def remap(table: UInt32, pointer: Pointer) -> Pointer:
    """Return the previous scene's object for the current scene's `pointer`. `table` is one of `ScenePair.tables()`."""
    return dr.reinterpret_array(type(pointer), dr.gather(mi.UInt32, table, registry_id(pointer)))  # pyright: ignore[reportReturnType]


class StatePointers:
    """Objects of each traced state: of the current scene or, for a pair, of the current and of the previous one.

    Args:
        tables: `ScenePair.tables()`; used for a pair only.
        pair: whether the previous state is traced too.
    """

    def __init__(self, tables: Mapping[str, Any], pair: bool):
        self._tables = tables
        self.pair = pair

    def _of(self, kind: str, pointer: Pointer) -> list[Pointer]:
        return [pointer, remap(self._tables[kind], pointer)] if self.pair else [pointer]

    def bsdfs(self, bsdf: mi.BSDFPtr) -> list[mi.BSDFPtr]:
        """Return the BSDF of each state."""
        return self._of("bsdf", bsdf)

    def emitters(self, emitter: mi.EmitterPtr) -> list[mi.EmitterPtr]:
        """Return the emitter of each state."""
        return self._of("emitter", emitter)

    def media(self, medium: mi.MediumPtr) -> list[mi.MediumPtr]:
        """Return the medium of each state."""
        return self._of("medium", medium)

    def interactions(self, si: mi.SurfaceInteraction3f) -> list[mi.SurfaceInteraction3f]:
        """Return `si` on the shape of each state."""
        if not self.pair:
            return [si]
        siₚ = mi.SurfaceInteraction3f(si)
        siₚ.shape = remap(self._tables["shape"], si.shape)
        return [si, siₚ]


def pointer_table(current: Any, previous: Any) -> mi.UInt32:
    """Return the table from the registry ids of one load's pointers to those of another load.

    Raises `InputError` if the two loads differ in their number.
    """
    source = dr.reinterpret_array(mi.UInt32, current).numpy()  # pyright: ignore[reportAttributeAccessIssue]
    target = dr.reinterpret_array(mi.UInt32, previous).numpy()  # pyright: ignore[reportAttributeAccessIssue]
    if source.shape != target.shape:
        raise InputError("scene: two loads of the description differ in their shapes or emitters")
    table = np.zeros(int(source.max(initial=0)) + 1, np.uint32)
    table[source] = target
    return mi.UInt32(table)
