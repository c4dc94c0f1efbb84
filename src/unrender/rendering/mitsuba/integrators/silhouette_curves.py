"""Curves at which what a viewpoint sees may jump: edges of meshes, and of spheres, discs and cylinders in closed form."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba.edges import EdgeTable

__all__ = ["SilhouetteCurves"]

_ARCS = 16
"""That a curve is cut into, to be chosen by their lengths on the picture."""
_SPHERE, _CIRCLE, _TOP, _LEFT, _RIGHT = range(5)
"""Kinds of curves, in the coordinates of the shape: a unit sphere's silhouette, unit circles at z = 0 and z = 1, and the two lines at
which a cylinder between them turns away."""
_CURVES = {"Sphere": (_SPHERE,), "Disk": (_CIRCLE,), "Cylinder": (_CIRCLE, _TOP, _LEFT, _RIGHT)}


class SilhouetteCurves:
    """The curves of a scene that does not move, in pieces.

    Args:
        scene: of Mitsuba.
        table: its edges.

    Attributes:
        count: of pieces.
    """

    def __init__(self, scene: Any, table: EdgeTable):
        self._table = table
        self._positions = dr.detach(table.positions(scene)) if table.count else mi.Float(0)
        rows, kinds = [], []
        for shape in scene.shapes():
            for kind in _CURVES.get(shape.class_name(), ()):
                kinds.append(kind)
                rows.append(
                    np.array(mi.traverse(shape)["to_world"].matrix).reshape(4, 4)[  # pyright: ignore[reportAttributeAccessIssue]
                        :3
                    ]
                )
        self._kinds = mi.UInt32(kinds or [0])
        self._matrices = mi.Float(np.array(rows or np.zeros((1, 3, 4)), np.float32).reshape(-1))
        self.count = table.count + _ARCS * len(kinds)

    def at(self, index: Any, u: Any, viewpoint: Any) -> tuple[Any, Any, Any]:
        """Points of these pieces, from 0 to 1 along them, their derivatives by u, and whether what `viewpoint` sees may jump there."""
        viewpoint = mi.Point3f(viewpoint)
        if self._table.count == 0:
            return self._analytic(index, u, viewpoint)
        of_mesh = index < self._table.count
        edge = self._table.at(self._positions, dr.minimum(index, self._table.count - 1))
        point, along = dr.lerp(edge.start, edge.end, u), edge.end - edge.start
        found = mi.Point3f(point), mi.Vector3f(along), edge.is_silhouette(viewpoint - 0.5 * (edge.start + edge.end))
        if self.count > self._table.count:
            others = self._analytic(dr.select(of_mesh, 0, index - self._table.count), u, viewpoint)
            found = tuple(dr.select(of_mesh, a, b) for a, b in zip(found, others, strict=True))
        return found

    def _analytic(self, index: Any, u: Any, viewpoint: Any) -> tuple[Any, Any, Any]:
        curve = index // _ARCS
        kind = dr.gather(mi.UInt32, self._kinds, curve)
        m = [dr.gather(mi.Float, self._matrices, curve * 12 + k) for k in range(12)]
        linear = mi.Matrix3f(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10])
        shift = mi.Vector3f(m[3], m[7], m[11])
        local = mi.Vector3f(dr.rcp(linear) @ (mi.Vector3f(viewpoint) - shift))
        t = (index - curve * _ARCS + u) / _ARCS
        s, c = dr.sincos(dr.two_pi * t)
        point = mi.Vector3f(c, s, dr.select(kind == _TOP, 1.0, 0.0))
        along = mi.Vector3f(-s, c, 0) * dr.two_pi
        exists = mi.Bool(True)
        # A sphere: the circle of the points x with x · v = 1.
        distance = dr.norm(local)
        axis = local / dr.maximum(distance, 1e-20)
        frame = mi.Frame3f(axis)
        size = dr.safe_sqrt(1 - dr.rcp(dr.maximum(dr.square(distance), 1e-20)))
        sphere = kind == _SPHERE
        point = dr.select(sphere, axis / dr.maximum(distance, 1e-20) + size * (c * frame.s + s * frame.t), point)
        along = dr.select(sphere, size * dr.two_pi * (c * frame.t - s * frame.s), along)
        exists &= ~sphere | (distance > 1)
        # A cylinder: the lines at the angles whose cosine from the viewpoint is 1 / distance.
        flat = dr.sqrt(dr.square(local.x) + dr.square(local.y))
        line = (kind == _LEFT) | (kind == _RIGHT)
        turned = dr.safe_acos(dr.rcp(dr.maximum(flat, 1e-20))) * dr.select(kind == _LEFT, -1.0, 1.0)
        ls, lc = dr.sincos(dr.atan2(local.y, local.x) + turned)
        point = dr.select(line, mi.Vector3f(lc, ls, t), point)
        along = dr.select(line, mi.Vector3f(0, 0, 1), along)
        exists &= ~line | (flat > 1)
        return mi.Point3f(linear @ point + shift), mi.Vector3f(linear @ along) / _ARCS, exists
