"""Bounds of meshes by slabs of seven directions (discrete oriented polytopes), and which segments meet them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float

__all__ = ["meets", "slab_bounds"]

_AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1))
"""Normals of the slabs: faces and corners of a cube."""

_PADDING = 1e-4
"""Of the largest coordinate: far above what the intersection of rays rounds off."""


def slab_bounds(meshes: Sequence[Sequence[Any]]) -> Float:
    """Bounds, 14 numbers for each: the upper and, negated, the lower end along each direction.

    Args:
        meshes: for each bound, the flat vertex positions of what it holds.
    """
    bounds = []
    for parts in meshes:
        points = [dr.unravel(mi.Point3f, positions) for positions in parts]
        upper = []
        for axis in _AXES:
            along = dr.concat([dr.dot(mi.Vector3f(axis), mi.Vector3f(at)) for at in points])
            upper += [along, -along]
        widest = dr.block_reduce(dr.ReduceOp.Max, dr.concat(upper), dr.width(upper[0]))
        bounds.append(widest + _PADDING * dr.max(dr.abs(widest)))
    return dr.concat(bounds)


def meets(bounds: Float, ray: Any, t: Float) -> Bool:
    """Whether a ray may meet any of the bounds at a distance of at most `t`: never wrongly no."""
    found = mi.Bool(False)
    ends = [_ends(ray, axis) for axis in _AXES]
    for first in range(0, dr.width(bounds), 2 * len(_AXES)):
        near, far = mi.Float(0), mi.Float(t)
        for number, (o, inverse) in enumerate(ends):
            index = first + 2 * number
            a = (dr.gather(mi.Float, bounds, index) - o) * inverse
            b = (-dr.gather(mi.Float, bounds, index + 1) - o) * inverse
            near, far = dr.maximum(near, dr.minimum(a, b)), dr.minimum(far, dr.maximum(a, b))
        found |= near <= far
    return found


def _ends(ray: Any, axis: tuple[int, int, int]) -> tuple[Float, Float]:
    """A ray's origin along a direction, and the inverse of its own direction along it."""
    along = dr.dot(ray.d, mi.Vector3f(axis))
    return dr.dot(mi.Vector3f(ray.o), mi.Vector3f(axis)), dr.rcp(dr.select(dr.abs(along) < 1e-12, 1e-12, along))
