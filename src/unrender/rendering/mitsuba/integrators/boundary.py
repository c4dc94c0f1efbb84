"""The part of a derivative that path replay leaves out: how the borders of what is visible move.

At an edge of a mesh, radiance jumps from L⁻ on one side to L⁺ on the other. An integral over directions at a point x_a changes by the
jump times the speed at which the edge, seen from x_a, moves along its normal n (Li et al. 2018). With the edge point x_b, moving by v_b,
x_a by v_a, and c the next point beyond x_b on a side, that side's part of the jump moves by

    n · (v_b − v_a |bc| / |ac|)

where path replay holds c as it differentiates the integral over surfaces at x_a (|bc| / |ac| = 1 where there is none). Paths are
built from the edge outwards (Zhang et al. 2020): edge point and direction are sampled, x_a and c are traced, x_a is connected with the
sensor, at once or by way of further vertices.

Three disjoint parts, each of its own sampling:
    primary   x_a is the sensor: edges on the picture.
    shadows   c is on an emitter: edges as seen from points on emitters, delta emitters among them.
    indirect  all other light that the jump is made of: edges and directions, uniformly.

Left out: what is seen of edges in perfect mirrors and through glass, where x_a cannot be connected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.edges import EdgePoints, EdgeTable
from unrender.rendering.mitsuba.film import RepeatingSampler

__all__ = ["BoundaryIntegrator"]

_OFFSET = 1e-4
"""To the two sides of an edge: of the picture's side or, in space, of 1 + the largest coordinate."""
_NEAR = 1e-3
"""Share of a distance within which nothing occludes."""
_VIEWPOINTS, _PAIRS = 256, 1 << 20
"""Points on all emitters from which shadows' edges are looked for, at most; and their pairs with edges, as far as that allows."""


class BoundaryIntegrator:
    """Boundary derivatives of what a perspective sensor sees.

    Args:
        table: the scene's edges.
        max_depth: longest path in segments, >= 1.
    """

    # No dataclass: Dr.Jit would take it for state of its loops.
    def __init__(self, table: EdgeTable, max_depth: int):
        self._table, self._max_depth = table, max_depth
        self._radiance: Any = mi.load_dict({"type": "prb_projective", "max_depth": max_depth, "rr_depth": max_depth})

    def weighted_image(self, scene: Any, sensor: Any, weights: Any, seed: int, samples: int) -> Any:
        """Σ weights · image, of which only the derivative is of use: attached to the meshes' positions. Unbiased.

        Args:
            scene, sensor: of Mitsuba; the sensor is perspective.
            weights: `mi.TensorXf` (H, W, 3), derivative of the loss by each element of the image; box filter.
            seed: in [0, 2**32).
            samples: of each of the three parts.
        """
        with dr.resume_grad():
            positions = self._table.positions(scene)
        picture = _Picture(scene, sensor, weights, samples)
        if self._table.moving == 0:
            return mi.Float(0)
        found = self._primary(picture, positions, seed)
        if self._max_depth >= 2 and len(scene.emitters()) > 0:
            found += self._shadows(picture, positions, seed ^ 0x5BD1E995)
        if self._max_depth >= 3:
            found += self._indirect(picture, positions, seed ^ 0x1B873593)
        return found

    # ------------------------------------------------------------------ edges on the picture

    def _primary(self, picture: _Picture, positions: Any, seed: int) -> Any:
        table, scene = self._table, picture.scene
        camera = dr.detach(picture.sensor.world_transform()) @ mi.Point3f(0)
        with dr.suspend_grad():
            all_edges = table.at(positions, dr.arange(mi.UInt32, table.moving))
            middle = 0.5 * (all_edges.start + all_edges.end)
            jumps = all_edges.is_silhouette(camera - middle) | (all_edges.crease & ~_coplanar(all_edges))
            weight = dr.norm(all_edges.end - all_edges.start) / dr.norm(middle - camera)
            chosen = _Choice(dr.select(jumps, weight, 0))
            sampler = _sampler(seed, picture.samples, picture.samples)
            index, pmf = chosen.draw(sampler.next_1d())
            u = sampler.next_1d()
        with dr.resume_grad():
            edge = table.at(positions, index)
            point = dr.lerp(edge.start, edge.end, u)
        with dr.suspend_grad():
            uv, depth = picture.project(point)
            along = picture.project_motion(point, uv, edge.end - edge.start)
            length = dr.norm(along)
            normal = mi.Vector2f(-along.y, along.x) / dr.maximum(length, 1e-20)
            active = (pmf > 0) & (length > 1e-12) & (depth > 0) & dr.all((uv >= 0) & (uv < 1))
            towards = mi.Point3f(dr.detach(point)) - camera
            ray = mi.Ray3f(camera, dr.normalize(towards))
            ray.maxt = dr.norm(towards) * (1 - _NEAR)
            active &= ~scene.ray_test(ray, active)
            jump = self._picture_jump(picture, uv, normal, dr.norm(towards), active, seed ^ 0x9E3779B9)
            weighted = picture.weighted(jump, uv * picture.size, active)
            scale = dr.select(active, weighted * length / pmf, 0)
        with dr.resume_grad():
            moved = picture.project_motion(dr.detach(point), uv, point)
            return picture.scale * dr.sum(scale * dr.dot(normal, moved))

    def _picture_jump(self, picture: _Picture, uv: Any, normal: Any, distance: Any, active: Any, seed: int) -> Any:
        """Radiance before an edge on the picture (against its normal) less radiance beyond it."""
        count = picture.samples
        number = dr.arange(mi.UInt32, 2 * count)
        lane = number % count
        sign = dr.select(number < count, -_OFFSET, _OFFSET)
        at = dr.gather(mi.Point2f, uv, lane) + sign * dr.gather(mi.Vector2f, normal, lane)
        both = dr.gather(mi.Bool, active, lane)
        ray, weight = picture.sensor.sample_ray(0.0, 0.5, at, mi.Point2f(0.5), both)
        near = dr.gather(mi.Float, distance, lane)
        si = _facing(picture.scene.ray_intersect(ray, both), ray, near)
        L = self._trace(picture.scene, ray, si, mi.UInt32(0), both, seed, count) * weight
        return _halves_difference(L, count)

    # ------------------------------------------------------------------ edges between a point and an emitter

    def _shadows(self, picture: _Picture, positions: Any, seed: int) -> Any:
        table, scene, count = self._table, picture.scene, picture.samples
        with dr.suspend_grad():
            lights = _Viewpoints(scene, seed ^ 0x2545F491, min(_VIEWPOINTS, _PAIRS // table.count))
            number = dr.arange(mi.UInt32, lights.count * table.count)
            which = number // table.count
            edges = table.at(positions, number - which * table.count)
            middle = 0.5 * (edges.start + edges.end)
            direction, distance = lights.seen_from(middle, which)
            across = dr.norm(dr.cross(edges.end - edges.start, direction))
            weight = across * lights.measure(middle, which, distance, direction)
            chosen = _Choice(dr.select(edges.is_silhouette(direction), weight, 0))
            sampler = _sampler(seed, count, count)
            number, pmf = chosen.draw(sampler.next_1d())
            which = number // table.count
            u = sampler.next_1d()
        with dr.resume_grad():
            edge = table.at(positions, number - which * table.count)
            point = dr.lerp(edge.start, edge.end, u)
        with dr.suspend_grad():
            b = mi.Point3f(dr.detach(point))
            direction, distance = lights.seen_from(b, which)
            segment = _BoundarySegment(edge, b, direction)
            active = (pmf > 0) & segment.valid
            ray = mi.Ray3f(segment.outside, direction)
            ray.maxt = distance * (1 - _NEAR)
            active &= ~scene.ray_test(ray, active)
            light = lights.arriving(b, which, direction, distance, active)
            active &= dr.any(light != 0)
            light *= segment.length * segment.sine / pmf
            share = lights.share(scene, segment, distance, which)
        eye = _EyePath(picture, segment, sampler, self._max_depth - 2, active)
        with dr.suspend_grad():
            weighted = picture.weighted(eye.throughput * light, eye.position, eye.active)
            ratio = share(dr.norm(b - eye.first.p))
        with dr.resume_grad():
            motion = dr.dot(segment.normal, point - ratio * eye.moved)
            return -picture.scale * dr.sum(dr.select(eye.active, weighted, 0) * motion)

    # ------------------------------------------------------------------ edges and directions

    def _indirect(self, picture: _Picture, positions: Any, seed: int) -> Any:
        table, scene, count = self._table, picture.scene, picture.samples
        with dr.suspend_grad():
            edges = table.at(positions, dr.arange(mi.UInt32, table.count))
            chosen = _Choice(dr.norm(edges.end - edges.start) * _Wedge(edges).angle)
            sampler = _sampler(seed, count, count)
            index, pmf = chosen.draw(sampler.next_1d())
            u = sampler.next_1d()
        with dr.resume_grad():
            edge = table.at(positions, index)
            point = dr.lerp(edge.start, edge.end, u)
        with dr.suspend_grad():
            wedge = _Wedge(edge)
            direction = wedge.direction(sampler.next_1d(), sampler.next_1d())
            segment = _BoundarySegment(edge, mi.Point3f(dr.detach(point)), direction)
            active = (pmf > 0) & segment.valid & (wedge.angle > 0)
        eye = _EyePath(picture, segment, sampler, self._max_depth - 3, active)
        with dr.suspend_grad():
            L, far = self._both_sides(scene, segment, eye, seed ^ 0x9E3779B9)
            factor = segment.length * segment.sine * 4 * wedge.angle / pmf
            near = dr.norm(segment.point - eye.first.p)
            parts = []
            for side, sign in ((0, 1.0), (1, -1.0)):
                weighted = picture.weighted(eye.throughput * L[side] * (sign * factor), eye.position, eye.active)
                ratio = dr.select(dr.isfinite(far[side]), dr.maximum(far[side] - near, 0) / far[side], 1)
                parts.append((dr.select(eye.active, weighted, 0), ratio))
        with dr.resume_grad():
            total = mi.Float(0)
            for weighted, ratio in parts:
                total += dr.sum(weighted * dr.dot(segment.normal, point - ratio * eye.moved))
            return picture.scale * total

    def _both_sides(
        self, scene: Any, segment: _BoundarySegment, eye: _EyePath, seed: int
    ) -> tuple[list[Any], list[Any]]:
        """Reflected radiance that arrives at x_a from the inner and from the outer side of an edge, and from what distances."""
        count = dr.width(segment.point)
        number = dr.arange(mi.UInt32, 2 * count)
        lane = number % count
        target = dr.select(
            number < count,
            dr.gather(mi.Point3f, segment.inside, lane),
            dr.gather(mi.Point3f, segment.outside, lane),
        )
        active = dr.gather(mi.Bool, eye.active, lane)
        origin = dr.gather(mi.Point3f, mi.Point3f(eye.first.spawn_ray(segment.direction).o), lane)
        ray = mi.Ray3f(origin, dr.normalize(target - origin))
        depth = dr.gather(mi.UInt32, eye.bounces, lane) + 1
        si = _facing(scene.ray_intersect(ray, active), ray, dr.norm(target - origin))
        emitted = si.emitter(scene, active).eval(si, active)
        L = self._trace(scene, ray, si, depth, active, seed, count) - emitted
        L = dr.select(active, L, 0)
        far = dr.select(si.is_valid(), si.t, dr.inf)
        dr.eval(L, far)
        halves = [dr.arange(mi.UInt32, count) + start for start in (0, count)]
        radiance = [mi.Spectrum(*(dr.gather(mi.Float, L[c], half) for c in range(3))) for half in halves]
        return radiance, [dr.gather(mi.Float, far, half) for half in halves]

    def _trace(self, scene: Any, ray: Any, si: Any, depth: Any, active: Any, seed: int, period: int) -> Any:
        """The radiance along rays that meet `si`, of which `depth` segments came before; the same random numbers after `period` lanes."""
        sampler = _sampler(seed, period, dr.width(ray.o))
        with dr.suspend_grad():
            return self._radiance.sample(dr.ADMode.Primal, scene, sampler, ray, depth, None, None, active, False, si)[0]


class _Picture:
    """A perspective sensor's film, and the weights of its pixels."""

    def __init__(self, scene: Any, sensor: Any, weights: Any, samples: int):
        size = sensor.film().crop_size()
        self.scene, self.sensor, self.samples = scene, sensor, samples
        self.width, self.height = int(size[0]), int(size[1])
        self.size = mi.Vector2f(self.width, self.height)
        self.scale = self.width * self.height / samples
        self._weights = weights.array
        with dr.suspend_grad():
            matrix = dr.detach(sensor.projection_transform().matrix) @ dr.detach(
                sensor.world_transform().inverse().matrix
            )
        self._rows = [mi.Vector4f(*(matrix[row, column] for column in range(4))) for row in range(4)]

    def _row(self, number: int, v: Any, last: float) -> Any:
        row = self._rows[number]
        return row.x * v.x + row.y * v.y + row.z * v.z + row.w * last

    def project(self, point: Any) -> tuple[Any, Any]:
        """Where points are on the film, from 0 to 1, and how far in front."""
        p = dr.detach(point)
        w = self._row(3, p, 1.0)
        return mi.Point2f(self._row(0, p, 1.0), self._row(1, p, 1.0)) / w, w

    def project_motion(self, point: Any, uv: Any, motion: Any) -> Any:
        """The motion on the film of points at `uv` that move in space."""
        w = self._row(3, dr.detach(point), 1.0)
        x, y, change = (self._row(number, motion, 0.0) for number in (0, 1, 3))
        return mi.Vector2f(x - uv.x * change, y - uv.y * change) / w

    def weighted(self, value: Any, position: Any, active: Any) -> Any:
        """Σ over channels of value times weight of the pixel at `position`, in pixels."""
        x = dr.clip(mi.Int32(dr.floor(position.x)), 0, self.width - 1)
        y = dr.clip(mi.Int32(dr.floor(position.y)), 0, self.height - 1)
        index = mi.UInt32(y * self.width + x) * 3
        parts = [value[c] * dr.gather(mi.Float, self._weights, index + c, active) for c in range(3)]
        return parts[0] + parts[1] + parts[2]


class _BoundarySegment:
    """A direction through an edge point; its normal points away from the first face. All detached."""

    def __init__(self, edge: EdgePoints, point: Any, direction: Any):
        start, end = dr.detach(edge.start), dr.detach(edge.end)
        self.point, self.direction = point, direction
        self.length = dr.norm(end - start)
        across = dr.cross(direction, (end - start) / dr.maximum(self.length, 1e-20))
        self.sine = dr.norm(across)
        self.valid = (self.length > 0) & (self.sine > 1e-6)
        across = across / dr.maximum(self.sine, 1e-20)
        self.normal = mi.Vector3f(dr.select(dr.dot(across, edge.third - point) > 0, -across, across))
        shift = self.shift = _OFFSET * (1 + dr.max(dr.abs(point)))
        self._edge, self._along = edge, (end - start) / dr.maximum(self.length, 1e-20)
        self.outside = mi.Point3f(point + shift * self.normal)
        self.inside = mi.Point3f(point - shift * self.normal)

    def is_behind(self, origin: Any) -> Any:
        """Whether a point lies on one of the edge's own faces: those are in the way, where both look away."""
        from_edge, found = origin - self.point, mi.Bool(False)
        for third in (self._edge.third, self._edge.other_third):
            normal = dr.cross(self._along, third - self.point)
            height = dr.abs(dr.dot(normal, from_edge)) / dr.maximum(dr.norm(normal), 1e-20)
            found |= height < 2 * self.shift
        return found & (self._edge.crease | self._edge.always)


class _EyePath:
    """From x_a, behind an edge point, to the sensor, with a random number of vertices between.

    Attributes:
        first: x_a, `mi.SurfaceInteraction3f`.
        moved: x_a as a ray that comes from the sensor's side meets it; attached.
        throughput: importance over density.
        position: on the film in pixels.
        bounces: of it, and hence segments before x_a, less one.
        active: whether it got there.
    """

    def __init__(self, picture: _Picture, segment: _BoundarySegment, sampler: Any, most: int, active: Any):
        scene = picture.scene
        with dr.suspend_grad():
            ray = mi.Ray3f(segment.outside, -segment.direction)
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            active = active & si.is_valid() & ~segment.is_behind(si.p)
            self.first = si
            self.bounces, probability = _geometric(sampler.next_1d(), most)
            walk = _walk(scene, si, sampler, self.bounces, most, active)
            ds, importance = picture.sensor.sample_direction(walk.si, mi.Point2f(0.5), walk.active)
            active = walk.active & (ds.pdf > 0) & dr.any(importance > 0)
            active &= ~scene.ray_test(walk.si.spawn_ray_to(ds.p), active)
            wo = walk.si.to_local(ds.d)
            bsdf = walk.si.bsdf()
            value = bsdf.eval(mi.BSDFContext(mi.TransportMode.Importance), walk.si, wo, active)
            value *= _geometric_cosines(walk.si, wo, ds.d)
            self.throughput = dr.select(active, walk.β * value * importance / (ds.pdf * probability), 0)
            self.position, self.active = ds.uv, active & dr.any(self.throughput != 0)
            outgoing = dr.select(self.bounces == 0, ds.d, walk.first_direction)
            back = mi.Ray3f(si.p + outgoing, -outgoing)
        with dr.resume_grad():
            self.moved = pi.compute_surface_interaction(back, mi.RayFlags.Minimal, self.active).p


@dataclass
class _Walk:
    """Loop state of `_walk`."""

    si: mi.SurfaceInteraction3f
    β: mi.Spectrum
    first_direction: mi.Vector3f
    made: mi.UInt32
    active: mi.Bool


def _walk(scene: Any, si: Any, sampler: Any, bounces: Any, most: int, active: Any) -> _Walk:
    """Scatter importance at x_a and further vertices, `bounces` times."""
    state = _Walk(si, mi.Spectrum(1), mi.Vector3f(0, 0, 1), mi.UInt32(0), active)
    if most <= 0:
        return state
    context = mi.BSDFContext(mi.TransportMode.Importance)

    def going(state: _Walk, sampler: Any) -> Any:
        return state.active & (state.made < bounces)

    def bounce(state: _Walk, sampler: Any) -> tuple[_Walk, Any]:
        si, active = state.si, state.active
        bs, weight = si.bsdf().sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
        direction = si.to_world(bs.wo)
        β = state.β * weight * _geometric_cosines(si, bs.wo, direction)
        following = scene.ray_intersect(si.spawn_ray(direction), mi.RayFlags.All, coherent=False, active=active)
        first = dr.select(state.made == 0, direction, state.first_direction)
        active &= following.is_valid() & dr.any(β != 0)
        return _Walk(following, β, first, state.made + 1, active), sampler

    found, _ = dr.while_loop((state, sampler), going, bounce, label="eye path")
    # Those that ended before they had made all bounces are inactive; the others stopped with `active` as it was.
    found.active &= found.made == bounces
    return found


def _geometric_cosines(si: Any, wo: Any, direction: Any) -> Any:
    """What makes a BSDF's value, times the cosine of the shading normal to where importance goes, the same of radiance (Veach 1997,
    section 5.3)."""
    incoming = dr.dot(si.n, si.to_world(si.wi))
    below = incoming * mi.Frame3f.cos_theta(wo)
    above = mi.Frame3f.cos_theta(si.wi) * dr.dot(si.n, direction)
    return dr.select(dr.abs(below) > 1e-12, dr.abs(above / below), 0)


def _geometric(sample: Any, most: int) -> tuple[Any, Any]:
    """A number from 0 to `most` of which each is half as probable as the one before, the last two alike; and its probability."""
    number, probability, reached = mi.UInt32(0), mi.Float(1), mi.Float(0)
    if most <= 0:
        return number, probability
    probability = mi.Float(0.5)
    for step in range(1, most + 1):
        reached += 0.5**step
        beyond = sample >= reached
        number = dr.select(beyond, step, number)
        probability = dr.select(beyond, 0.5 ** min(step + 1, most), probability)
    return mi.UInt32(number), probability


class _Wedge:
    """Directions in which an edge is a silhouette: of all directions around it, 4 `angle`; all where shading jumps at it."""

    def __init__(self, edge: EdgePoints):
        start, end = dr.detach(edge.start), dr.detach(edge.end)
        self._tangent = dr.normalize(end - start)
        one, other = (self._across(third - start) for third in (edge.third, edge.other_third))
        cosine = dr.clip(dr.dot(one, other), -1, 1)
        everywhere = edge.always | (edge.crease & ~_coplanar(edge))
        self.angle = dr.select(everywhere, dr.pi, dr.pi - dr.safe_acos(cosine))
        self.angle = dr.select(self.angle > 1e-4, self.angle, 0)
        beyond = other - cosine * one
        size = dr.norm(beyond)
        beyond = dr.select(size > 1e-6, beyond / dr.maximum(size, 1e-20), dr.cross(self._tangent, one))
        # From the second face's plane, away from the first.
        self._begin = dr.select(everywhere, 0, dr.safe_acos(cosine))
        self._one, self._beyond = one, beyond

    def _across(self, v: Any) -> Any:
        flat = v - dr.dot(v, self._tangent) * self._tangent
        return flat / dr.maximum(dr.norm(flat), 1e-20)

    def direction(self, first: Any, second: Any) -> Any:
        """Uniform by solid angle."""
        cosine = 2 * first - 1
        sine = dr.safe_sqrt(1 - dr.square(cosine))
        doubled = 2 * second
        turned = doubled >= 1
        φ = self._begin + dr.select(turned, doubled - 1, doubled) * self.angle
        s, c = dr.sincos(φ)
        flat = c * self._one + s * self._beyond
        return mi.Vector3f(cosine * self._tangent + sine * dr.select(turned, -flat, flat))


def _coplanar(edge: EdgePoints) -> Any:
    """Whether two faces lie in one plane, and on two sides of the edge."""
    start = dr.detach(edge.start)
    a, b, c = dr.detach(edge.end) - start, edge.third - start, edge.other_third - start
    m, n = dr.cross(a, b), dr.cross(c, a)
    return (dr.dot(m, n) > 0) & (dr.norm(dr.cross(m, n)) <= 1e-5 * dr.norm(m) * dr.norm(n))


class _Viewpoints:
    """Points on emitters and directions to distant ones, the same number on each emitter."""

    def __init__(self, scene: Any, seed: int, count: int):
        emitters = scene.emitters()
        self._each = max(1, count // len(emitters))
        self.count = self._each * len(emitters)
        parts = [_emitter_points(emitter, seed + 7919 * i, self._each) for i, emitter in enumerate(emitters)]
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
        """Direction and distance of a viewpoint."""
        p, _, d, kind = self._gather(which)
        towards = p - dr.detach(point)
        distance = dr.norm(towards)
        far = kind == _DISTANT
        return (
            mi.Vector3f(dr.select(far, d, towards / dr.maximum(distance, 1e-20))),
            dr.select(far, dr.largest(mi.Float), distance),
        )

    def measure(self, point: Any, which: Any, distance: Any, direction: Any) -> Any:
        """Solid angle at the point over the density of the viewpoint; relative radiance is left out."""
        _, n, _, kind = self._gather(which)
        density = dr.gather(mi.Float, self._density, which) * self._each
        cosine = dr.maximum(-dr.dot(n, direction), 0)
        near = dr.select(kind == _AREA, cosine / dr.square(distance), 1)
        # Directions to emitters at a point: their radiance falls with the distance by itself.
        return dr.select(density > 0, near / density, 0)

    def arriving(self, point: Any, which: Any, direction: Any, distance: Any, active: Any) -> Any:
        """The radiance of the emitter at the viewpoint, times `measure`."""
        p, n, _, kind = self._gather(which)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(point))
        ds.p, ds.n, ds.d = dr.select(kind == _DISTANT, point + direction, p), n, direction
        ds.uv = dr.gather(mi.Point2f, self._uv, which)
        ds.dist, ds.pdf, ds.delta = distance, 1.0, False
        ds.emitter = dr.gather(mi.EmitterPtr, self._emitters, which)
        it = dr.zeros(mi.Interaction3f, dr.width(point))
        it.p = point
        value = ds.emitter.eval_direction(it, ds, active)
        return dr.select(active, value * self.measure(point, which, distance, direction), 0)

    def share(self, scene: Any, segment: _BoundarySegment, distance: Any, which: Any) -> Any:
        """From |ab| to |bc| / |ac|."""
        far = dr.gather(mi.UInt32, self._kind, which) == _DISTANT
        del scene, segment
        return lambda near: dr.select(far, 1, distance / (near + distance))


_AREA, _POINT, _DISTANT = 0, 1, 2


def _emitter_points(emitter: Any, seed: int, count: int) -> tuple[Any, ...]:
    """Points, normals, directions, texture coordinates, densities, kinds and the emitter, `count` lanes."""
    sampler = _sampler(seed & 0xFFFFFFFF, count, count)
    sample = sampler.next_2d()
    it = dr.zeros(mi.Interaction3f, count)
    shape = emitter.get_shape()
    zero = dr.zeros(mi.Float, count)
    pointer = dr.repeat(mi.EmitterPtr(emitter), count)
    if shape is not None:
        ps = shape.sample_position(0.0, sample)
        return (
            mi.Point3f(ps.p),
            mi.Normal3f(ps.n),
            mi.Vector3f(zero),
            ps.uv,
            ps.pdf + zero,
            mi.UInt32(zero) + _AREA,
            pointer,
        )
    ds, _ = emitter.sample_direction(it, sample)
    distant = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite) or mi.has_flag(
        emitter.flags(), mi.EmitterFlags.DeltaDirection
    )
    density = dr.select(ds.delta, 1, ds.pdf) + zero
    kind = mi.UInt32(zero) + (_DISTANT if distant else _POINT)
    wide = mi.Point3f(zero)
    return wide + ds.p, mi.Normal3f(zero), mi.Vector3f(zero) + ds.d, mi.Point2f(zero) + ds.uv, density, kind, pointer


class _Choice:
    """A number by its weight; the probability is 0 where no weight is positive."""

    def __init__(self, weights: Any):
        self._weights = dr.select(dr.isfinite(weights), weights, 0)
        dr.eval(self._weights)
        self._sums = dr.cumsum(self._weights)
        self._count = dr.width(self._weights)
        self._total = dr.gather(mi.Float, self._sums, self._count - 1)

    def draw(self, sample: Any) -> tuple[Any, Any]:
        """Numbers and their probabilities. `sample` is stratified over the lanes."""
        lanes = dr.width(sample)
        u = (dr.arange(mi.Float, lanes) + sample) / lanes * self._total
        index = dr.binary_search(0, self._count - 1, lambda i: dr.gather(mi.Float, self._sums, i) <= u)
        pmf = dr.gather(mi.Float, self._weights, index) / dr.maximum(self._total, 1e-30)
        return index, pmf


def _facing(si: Any, ray: Any, distance: Any) -> Any:
    """Interactions with the shading normal turned to the side that is seen, where they are about as far as an edge.

    Interpolated normals look away from the viewer in the last triangles before a silhouette, which are then black. The inner border of
    that rim jumps as the silhouette does, and moves with it: as if the one jump were the other's sum.
    """
    cosine = dr.dot(si.sh_frame.n, ray.d)
    turned = si.is_valid() & (cosine > -1e-4) & (dr.dot(si.n, ray.d) < 0)
    turned &= dr.abs(si.t - distance) < 0.05 * distance
    normal = dr.normalize(si.sh_frame.n - (cosine + 1e-4) * ray.d)
    frame = mi.Frame3f(normal)
    si.sh_frame = dr.select(turned, frame, si.sh_frame)
    si.wi = dr.select(turned, si.to_local(-ray.d), si.wi)
    return si


def _halves_difference(L: Any, count: int) -> Any:
    dr.eval(L)
    lane = dr.arange(mi.UInt32, count)
    return mi.Spectrum(*(dr.gather(mi.Float, L[c], lane) - dr.gather(mi.Float, L[c], lane + count) for c in range(3)))


def _sampler(seed: int, period: int, lanes: int) -> RepeatingSampler:
    sampler = RepeatingSampler(period)
    sampler.seed(dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), lanes)
    return sampler
