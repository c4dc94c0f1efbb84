"""Axis-aligned bounding ellipsoids of meshes, and their intersection with segments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float

_NUMBERS = 6
"""Numbers per ellipsoid."""

_THINNEST = 1e-2
"""Minimum half axis, relative to the longest half axis of the bounding box."""

_PADDING = 1e-4
"""Padding relative to the largest coordinate, larger than rounding errors of rays and bounds."""

_MARGIN = 1.01
"""Factor of the half axes, for the same reason."""


def bounding_ellipsoids(meshes: Sequence[Sequence[Any]]) -> Float:
    """Return the centre and the inverse half axes of an ellipsoid around each bounding box, 6 numbers each, `mi.Float`.

    The ellipsoids contain all points.

    Args:
        meshes: for each ellipsoid, flat arrays of the positions that it contains.
    """
    values = []
    for parts in meshes:
        points = dr.unravel(mi.Point3f, dr.concat([mi.Float(part) for part in parts]))
        low, high = (mi.Point3f(*(reduce(x) for x in points)) for reduce in (dr.min, dr.max))
        widest, largest = dr.max((high - low) / 2), dr.max(dr.maximum(dr.abs(low), dr.abs(high)))
        half = dr.maximum((high - low) / 2, _THINNEST * widest) + _PADDING * largest
        centre = (low + high) / 2
        half *= _MARGIN * dr.max(dr.norm((points - centre) / half))
        values += [*centre, *dr.rcp(half)]
    return dr.concat([mi.Float(number) for number in values])


class BoundingEllipsoids:
    """Ellipsoids in a kernel. This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.

    Args:
        numbers: result of `bounding_ellipsoids`, an array in memory.
    """

    def __init__(self, numbers: Float):
        # Gather once, before the loop over a path's vertices.
        each = [dr.gather(mi.Float, numbers, index) for index in range(dr.width(numbers))]
        parts = [each[first : first + _NUMBERS] for first in range(0, len(each), _NUMBERS)]
        self._ellipsoids = [(mi.Point3f(*part[:3]), mi.Vector3f(*part[3:])) for part in parts]

    def meet(self, ray: Any, t: Float) -> Bool:
        """Return whether a ray intersects any of the ellipsoids at a distance of at most `t`."""
        hit = mi.Bool(False)
        for centre, scale in self._ellipsoids:
            to, d = mi.Vector3f((centre - ray.o) * scale), mi.Vector3f(ray.d * scale)
            nearest = dr.clip(dr.dot(to, d) / dr.squared_norm(d), 0, t)
            hit |= dr.squared_norm(to - nearest * d) <= 1
        return hit
