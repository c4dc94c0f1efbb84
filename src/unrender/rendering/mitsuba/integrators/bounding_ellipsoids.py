"""Ellipsoids about meshes, their axes those of the world, and which segments meet them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float

_NUMBERS = 6
"""Of each ellipsoid."""

_THINNEST = 1e-2
"""Of an ellipsoid's longest axis."""

_PADDING = 1e-4
"""Of the largest coordinate: above what rays and bounds round off."""

_MARGIN = 1.01
"""Of the radius, likewise."""


def bounding_ellipsoids(meshes: Sequence[Sequence[Any]]) -> Float:
    """One about the bounding box of each, scaled until it holds all points: its centre, and the inverse of its half axes.

    Args:
        meshes: for each ellipsoid, flat arrays of the positions that it is to hold.
    """
    found = []
    for parts in meshes:
        points = dr.unravel(mi.Point3f, dr.concat([mi.Float(part) for part in parts]))
        low, high = (mi.Point3f(*(reduce(x) for x in points)) for reduce in (dr.min, dr.max))
        widest, largest = dr.max((high - low) / 2), dr.max(dr.maximum(dr.abs(low), dr.abs(high)))
        half = dr.maximum((high - low) / 2, _THINNEST * widest) + _PADDING * largest
        centre = (low + high) / 2
        half *= _MARGIN * dr.max(dr.norm((points - centre) / half))
        found += [*centre, *dr.rcp(half)]
    return dr.concat([mi.Float(number) for number in found])


class BoundingEllipsoids:
    """Ellipsoids in a kernel. No dataclass: Dr.Jit would take it for state of its loops.

    Args:
        numbers: of `bounding_ellipsoids`, an array in memory.
    """

    def __init__(self, numbers: Float):
        # Read once, before the loop over a path's vertices.
        each = [dr.gather(mi.Float, numbers, index) for index in range(dr.width(numbers))]
        parts = [each[first : first + _NUMBERS] for first in range(0, len(each), _NUMBERS)]
        self._ellipsoids = [(mi.Point3f(*part[:3]), mi.Vector3f(*part[3:])) for part in parts]

    def meet(self, ray: Any, t: Float) -> Bool:
        """Whether a ray comes into any of the ellipsoids at a distance of at most `t`."""
        found = mi.Bool(False)
        for centre, scale in self._ellipsoids:
            to, d = mi.Vector3f((centre - ray.o) * scale), mi.Vector3f(ray.d * scale)
            nearest = dr.clip(dr.dot(to, d) / dr.squared_norm(d), 0, t)
            found |= dr.squared_norm(to - nearest * d) <= 1
        return found
