"""Sampling of boundary derivatives: edges by weight, directions in which an edge is a silhouette, and points on emitters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.edges import EdgePoints
from unrender.rendering.mitsuba.integrators.emitters import has_sun, inside_sun
from unrender.rendering.mitsuba.samplers import RepeatingSampler

_AREA, _POINT, _DISTANT = 0, 1, 2  # kinds of emitters: area, point, and distant


class WeightedChoice:
    """Discrete sampling of an index in proportion to its weight. The probability is 0 if no weight is positive."""

    def __init__(self, weights: Any):
        self._weights = dr.select(dr.isfinite(weights), weights, 0)
        dr.eval(self._weights)
        self._sums = dr.cumsum(self._weights)
        self._count = dr.width(self._weights)
        self._total = dr.gather(mi.Float, self._sums, self._count - 1)

    def draw(self, sample: Any) -> tuple[Any, Any]:
        """Return indices and their probabilities. `sample` is stratified over the lanes."""
        lanes = dr.width(sample)
        u = (dr.arange(mi.Float, lanes) + sample) / lanes * self._total
        index = dr.binary_search(0, self._count - 1, lambda i: dr.gather(mi.Float, self._sums, i) <= u)
        pmf = dr.gather(mi.Float, self._weights, index) / dr.maximum(self._total, 1e-30)
        return index, pmf


class SilhouetteWedge:
    """Directions in which an edge is a silhouette. Their solid angle is 4 `angle`; all directions if shading is discontinuous at the
    edge."""

    def __init__(self, edge: EdgePoints):
        start, end = dr.detach(edge.start), dr.detach(edge.end)
        self._tangent = dr.normalize(end - start)
        one, other = (self._across(third - start) for third in (edge.third, edge.other_third))
        cosine = dr.clip(dr.dot(one, other), -1, 1)
        everywhere = edge.always | (edge.crease & ~coplanar(edge))
        self.angle = dr.select(everywhere, dr.pi, dr.pi - dr.safe_acos(cosine))
        self.angle = dr.select(self.angle > 1e-4, self.angle, 0)
        beyond = other - cosine * one
        size = dr.norm(beyond)
        beyond = dr.select(size > 1e-6, beyond / dr.maximum(size, 1e-20), dr.cross(self._tangent, one))
        # The wedge begins at the second face's plane, away from the first.
        self._begin = dr.select(everywhere, 0, dr.safe_acos(cosine))
        self._one, self._beyond = one, beyond

    def _across(self, v: Any) -> Any:
        flat = v - dr.dot(v, self._tangent) * self._tangent
        return flat / dr.maximum(dr.norm(flat), 1e-20)

    def direction(self, first: Any, second: Any) -> Any:
        """Sample a direction, uniformly by solid angle."""
        cosine = 2 * first - 1
        sine = dr.safe_sqrt(1 - dr.square(cosine))
        doubled = 2 * second
        flipped = doubled >= 1
        φ = self._begin + dr.select(flipped, doubled - 1, doubled) * self.angle
        s, c = dr.sincos(φ)
        flat = c * self._one + s * self._beyond
        return mi.Vector3f(cosine * self._tangent + sine * dr.select(flipped, -flat, flat))


def coplanar(edge: EdgePoints) -> Any:
    """Return whether two faces lie in one plane, on opposite sides of the edge."""
    start = dr.detach(edge.start)
    a, b, c = dr.detach(edge.end) - start, edge.third - start, edge.other_third - start
    m, n = dr.cross(a, b), dr.cross(c, a)
    return (dr.dot(m, n) > 0) & (dr.norm(dr.cross(m, n)) <= 1e-5 * dr.norm(m) * dr.norm(n))


class EmitterPoints:
    """Points on emitters of a scene and directions to distant ones, the same number on each emitter, at least one; `count` in all."""

    def __init__(self, scene: Any, seed: int, count: int, time: Any):
        self._time = time
        emitters = scene.emitters()
        self._each = max(1, count // len(emitters))
        self.count = self._each * len(emitters)
        parts = [_emitter_points(emitter, seed + 7919 * i, self._each, time) for i, emitter in enumerate(emitters)]
        self._p, self._n, self._d = (
            type(first)(*(dr.concat([part[k][c] for part in parts]) for c in range(3)))
            for k, first in enumerate(parts[0][:3])
        )
        self._uv = mi.Point2f(*(dr.concat([part[3][c] for part in parts]) for c in range(2)))
        self._density = dr.concat([part[4] for part in parts])
        self._kind = dr.concat([part[5] for part in parts])
        self._emitters = dr.concat([part[6] for part in parts])

    def _gather(self, which: Any) -> tuple[Any, Any, Any, Any]:
        return (
            dr.gather(mi.Point3f, self._p, which),
            dr.gather(mi.Normal3f, self._n, which),
            dr.gather(mi.Vector3f, self._d, which),
            dr.gather(mi.UInt32, self._kind, which),
        )

    def seen_from(self, point: Any, which: Any) -> tuple[Any, Any]:
        """Return direction and distance from a point to an emitter point."""
        p, _, d, kind = self._gather(which)
        towards = p - dr.detach(point)
        distance = dr.norm(towards)
        far = kind == _DISTANT
        return (
            mi.Vector3f(dr.select(far, d, towards / dr.maximum(distance, 1e-20))),
            dr.select(far, dr.largest(mi.Float), distance),
        )

    def measure(self, point: Any, which: Any, distance: Any, direction: Any) -> Any:
        """Return the solid angle at the point over the density of the emitter point. Relative radiance is not included."""
        _, n, _, kind = self._gather(which)
        density = dr.gather(mi.Float, self._density, which) * self._each
        cosine = dr.maximum(-dr.dot(n, direction), 0)
        near = dr.select(kind == _AREA, cosine / dr.square(distance), 1)
        # The radiance of a point emitter includes the inverse square of the distance.
        return dr.select(density > 0, near / density, 0)

    def arriving(self, point: Any, which: Any, direction: Any, distance: Any, active: Any) -> Any:
        """Return the radiance of the emitter at the emitter point, times `measure`."""
        p, n, _, kind = self._gather(which)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(point))
        ds.p, ds.n, ds.d = dr.select(kind == _DISTANT, point + direction, p), n, direction
        ds.uv = dr.gather(mi.Point2f, self._uv, which)
        ds.dist, ds.pdf, ds.delta = distance, 1.0, False  # pyright: ignore[reportAttributeAccessIssue]
        ds.emitter = dr.gather(mi.EmitterPtr, self._emitters, which)
        it = dr.zeros(mi.Interaction3f, dr.width(point))
        it.p, it.time = point, self._time
        value = ds.emitter.eval_direction(it, ds, active)
        return dr.select(active, value * self.measure(point, which, distance, direction), 0)

    def share(self, distance: Any, which: Any) -> Callable[[Any], Any]:
        """Return |bc| / |ac| as a function of |ab|, for an emitter at `distance` |bc|."""
        far = dr.gather(mi.UInt32, self._kind, which) == _DISTANT
        return lambda near: dr.select(far, 1, distance / (near + distance))


def _emitter_points(emitter: Any, seed: int, count: int, time: Any) -> tuple[Any, ...]:
    """Return points, normals, directions, texture coordinates, densities, kinds and the emitter, `count` lanes."""
    sampler = lane_sampler(seed & 0xFFFFFFFF, count, count)
    sample = sampler.next_2d()
    it = dr.zeros(mi.Interaction3f, count)
    it.time = time
    shape = emitter.get_shape()
    zero = dr.zeros(mi.Float, count)
    pointer = dr.repeat(mi.EmitterPtr(emitter), count)

    def spread(values: Any) -> list[Any]:
        """Return the components at full width. Points may share one value, such as the normal of a flat shape."""
        return [component + zero for component in values]

    if shape is not None:
        ps = shape.sample_position(0.0, sample)
        direction, density, kind = mi.Vector3f(zero), ps.pdf + zero, mi.UInt32(zero) + _AREA
        return (
            mi.Point3f(*spread(ps.p)),
            mi.Normal3f(*spread(ps.n)),
            direction,
            mi.Point2f(*spread(ps.uv)),
            density,
            kind,
            pointer,
        )
    ds, _ = emitter.sample_direction(it, sample)
    distant = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite) or mi.has_flag(
        emitter.flags(), mi.EmitterFlags.DeltaDirection
    )
    density = dr.select(ds.delta, 1, ds.pdf) + zero
    kind = mi.UInt32(zero) + (_DISTANT if distant else _POINT)
    towards = ds.d
    if has_sun([emitter]):
        density = emitter.pdf_direction(it, ds)
        towards, _ = inside_sun(ds, sample, density, lambda other, lanes: emitter.sample_direction(it, other, lanes)[0])
    direction, uv = mi.Vector3f(*spread(towards)), mi.Point2f(*spread(ds.uv))
    return mi.Point3f(*spread(ds.p)), mi.Normal3f(zero), direction, uv, density, kind, pointer


def lane_sampler(seed: int, period: int, lanes: int) -> RepeatingSampler:
    """Return a seeded sampler of `lanes` lanes; lanes `period` apart have equal numbers."""
    sampler = RepeatingSampler(period)
    sampler.seed(dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), lanes)
    return sampler
