"""Boundary term of a derivative, which path replay omits: the motion of visibility discontinuities.

At an edge of a mesh, radiance jumps from L⁻ on one side to L⁺ on the other. An integral over directions at a point x_a changes by the
jump times the speed of the edge along its normal n, as seen from x_a (Li et al. 2018). Let x_b be the edge point with velocity v_b, v_a
the velocity of x_a, and c the next point beyond x_b on one side. The contribution of that side moves by

    n · (v_b − v_a |bc| / |ac|)

if path replay fixes c when it differentiates the integral over surfaces at x_a (|bc| / |ac| = 1 without a c). Paths are built from the
edge outwards (Zhang et al. 2020): an edge point and a direction are sampled, x_a and c are traced, and x_a is connected to the sensor,
directly or through further vertices.

There are four disjoint parts with different sampling:
    primary   x_a is the sensor: edges in the image.
    shadows   c is on an emitter: edges as seen from points on emitters, including delta emitters.
    lights    b is on the border of a moving emitter, whose own radiance ends there (c = b): its edges and directions, uniformly.
    indirect  all other radiance of the jump: edges and directions, uniformly.

Edges seen through perfect mirrors and glass are omitted, since x_a cannot be connected there.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.edges import EdgeTable
from unrender.rendering.mitsuba.integrators.aov import AovKernel
from unrender.rendering.mitsuba.integrators.base import registry_id
from unrender.rendering.mitsuba.integrators.boundary_paths import (
    OFFSET,
    BoundarySegment,
    EyePath,
    Picture,
    TangentPicture,
    WeightedPicture,
)
from unrender.rendering.mitsuba.integrators.boundary_sampling import (
    EmitterPoints,
    SilhouetteWedge,
    WeightedChoice,
    coplanar,
    lane_sampler,
)

_NEAR = 1e-3  # relative margin at the end of a shadow ray within which occluders are ignored
_OWN = 0.05
"""Relative distance from an edge of an emitter within which a point on the same emitter counts as the edge's face."""
_EMITTER_POINTS, _PAIRS = 256, 1 << 20
"""Maximum number of points on all emitters for shadow edges, and of pairs of a point with an edge."""


class BoundaryIntegrator:
    """Boundary derivatives of a perspective sensor's image, or of an AOV with a maximum depth of 1, from the jumps at the scene's edges."""

    # This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
    def __init__(self, table: EdgeTable, max_depth: int, aov: AovKernel | None = None):
        self._table, self._max_depth, self._aov = table, max_depth, aov
        self._radiance: Any = mi.load_dict({"type": "prb_projective", "max_depth": max_depth, "rr_depth": max_depth})

    def weighted_image(self, scene: Any, sensor: Any, weights: Any, seed: int, samples: int) -> Any:
        """Return a value whose derivative equals the boundary term of Σ weights · image, attached to the meshes' positions.

        It is unbiased up to the edges that the module omits, silhouettes of shapes that are not meshes, and the offset `OFFSET`. It takes
        `samples` of each part, of a seed in [0, 2**32).
        """
        return self._collected(WeightedPicture(scene, sensor, weights, samples), seed)

    def tangent_image(self, scene: Any, sensor: Any, seed: int, samples: int) -> Any:
        """Return the boundary term of the image's derivative, `mi.TensorXf` (H, W, 3), along the tangents of the meshes' positions. It
        is detached. For bias and arguments, see `weighted_image`."""
        picture = TangentPicture(scene, sensor, samples)
        self._collected(picture, seed)
        return picture.image()

    def _collected(self, picture: Picture, seed: int) -> Any:
        scene = picture.scene
        with dr.resume_grad():
            positions = self._table.positions(scene)
        if self._table.moving == 0:
            return mi.Float(0)
        total = self._primary(picture, positions, seed)
        if self._max_depth >= 2 and len(scene.emitters()) > 0:
            total += self._shadows(picture, positions, seed ^ 0x5BD1E995)
        if self._max_depth >= 2 and self._table.lit:
            total += self._lights(picture, positions, seed ^ 0x27D4EB2F)
        if self._max_depth >= 3:
            total += self._indirect(picture, positions, seed ^ 0x1B873593)
        return total

    # ------------------------------------------------------------------ edges on the picture

    def _primary(self, picture: Picture, positions: Any, seed: int) -> Any:
        table, scene = self._table, picture.scene
        camera = dr.detach(picture.sensor.world_transform()) @ mi.Point3f(0)
        with dr.suspend_grad():
            all_edges = table.at(positions, dr.arange(mi.UInt32, table.moving))
            middle = 0.5 * (all_edges.start + all_edges.end)
            jumps = all_edges.is_silhouette(camera - middle) | (all_edges.crease & ~coplanar(all_edges))
            weight = dr.norm(all_edges.end - all_edges.start) / dr.norm(middle - camera)
            chosen = WeightedChoice(dr.select(jumps, weight, 0))
            sampler = lane_sampler(seed, picture.samples, picture.samples)
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
            start, beyond = picture.near_point(camera, dr.detach(point), depth)
            active = (pmf > 0) & (length > 1e-12) & beyond & picture.stencil.is_sampled(uv)
            towards = mi.Point3f(dr.detach(point)) - start
            ray = mi.Ray3f(start, dr.normalize(towards))
            ray.maxt = dr.norm(towards) * (1 - _NEAR)
            active &= ~scene.ray_test(ray, active)
            jump = self._picture_jump(picture, uv, normal, dr.norm(towards), active, seed ^ 0x9E3779B9)
            jump *= length / pmf
        with dr.resume_grad():
            moved = picture.project_motion(dr.detach(point), uv, point)
            return picture.collect(jump, uv * picture.size, active, dr.dot(normal, moved))

    def _picture_jump(self, picture: Picture, uv: Any, normal: Any, distance: Any, active: Any, seed: int) -> Any:
        """Return the radiance before an edge in the image (against its normal) minus the radiance beyond it."""
        count = picture.samples
        number = dr.arange(mi.UInt32, 2 * count)
        lane = number % count
        sign = dr.select(number < count, -OFFSET, OFFSET)
        at = dr.gather(mi.Point2f, uv, lane) + sign * dr.gather(mi.Vector2f, normal, lane)  # pyright: ignore[reportOperatorIssue]
        both = dr.gather(mi.Bool, active, lane)
        ray, weight = picture.sensor.sample_ray(picture.time, 0.5, at, mi.Point2f(0.5), both)
        near = dr.gather(mi.Float, distance, lane)
        si = picture.scene.ray_intersect(ray, both)
        if self._aov is not None:
            return _halves_difference(self._aov.value(si, ray, both) * weight, count)
        si = _facing(si, ray, near)
        L = self._trace(picture.scene, ray, si, mi.UInt32(0), both, seed, count) * weight
        return _halves_difference(L, count)

    # ------------------------------------------------------------------ edges between a point and an emitter

    def _shadows(self, picture: Picture, positions: Any, seed: int) -> Any:
        table, scene, count = self._table, picture.scene, picture.samples
        with dr.suspend_grad():
            lights = EmitterPoints(scene, seed ^ 0x2545F491, min(_EMITTER_POINTS, _PAIRS // table.count), picture.time)
            number = dr.arange(mi.UInt32, lights.count * table.count)
            which = number // table.count
            edges = table.at(positions, number - which * table.count)
            middle = 0.5 * (edges.start + edges.end)
            direction, distance = lights.seen_from(middle, which)
            across = dr.norm(dr.cross(edges.end - edges.start, direction))
            weight = across * lights.measure(middle, which, distance, direction)
            chosen = WeightedChoice(dr.select(edges.is_silhouette(direction), weight, 0))
            sampler = lane_sampler(seed, count, count)
            number, pmf = chosen.draw(sampler.next_1d())
            which = number // table.count
            u = sampler.next_1d()
        with dr.resume_grad():
            edge = table.at(positions, number - which * table.count)
            point = dr.lerp(edge.start, edge.end, u)
        with dr.suspend_grad():
            b = mi.Point3f(dr.detach(point))
            direction, distance = lights.seen_from(b, which)
            segment = BoundarySegment(edge, b, direction)
            active = (pmf > 0) & segment.valid
            ray = mi.Ray3f(segment.outside, direction)
            ray.maxt = distance * (1 - _NEAR)
            active &= ~scene.ray_test(ray, active)
            light = lights.arriving(b, which, direction, distance, active)
            active &= dr.any(light != 0)
            light *= segment.length * segment.sine / pmf
            share = lights.share(distance, which)
        eye = EyePath(picture, segment, sampler, self._max_depth - 2, active)
        with dr.suspend_grad():
            ratio = share(dr.norm(b - eye.first.p))
        with dr.resume_grad():
            motion = dr.dot(segment.normal, point - ratio * eye.moved)
            return picture.collect(-eye.throughput * light, eye.position, eye.active, motion)

    # ------------------------------------------------------------------ edges and directions

    def _draw(
        self, picture: Picture, positions: Any, seed: int, most: int, emitters: Any = None
    ) -> tuple[Any, Any, BoundarySegment, EyePath, Any]:
        """Sample edges, by length and solid angle of their directions, a point of each and a direction; at most `most` vertices between x_a
        and the sensor.

        Edges of emitter id 0 are left out. Returns indices of edges, attached points, segments, eye paths, and the reciprocal density.
        """
        table, count = self._table, picture.samples
        with dr.suspend_grad():
            edges = table.at(positions, dr.arange(mi.UInt32, table.count))
            weight = dr.norm(edges.end - edges.start) * SilhouetteWedge(edges).angle
            chosen = WeightedChoice(weight if emitters is None else dr.select(emitters != 0, weight, 0))
            sampler = lane_sampler(seed, count, count)
            index, pmf = chosen.draw(sampler.next_1d())
            u = sampler.next_1d()
        with dr.resume_grad():
            edge = table.at(positions, index)
            point = dr.lerp(edge.start, edge.end, u)
        with dr.suspend_grad():
            wedge = SilhouetteWedge(edge)
            direction = wedge.direction(sampler.next_1d(), sampler.next_1d())
            segment = BoundarySegment(edge, mi.Point3f(dr.detach(point)), direction)
            active = (pmf > 0) & segment.valid & (wedge.angle > 0)
            factor = segment.length * segment.sine * 4 * wedge.angle / pmf
        return index, point, segment, EyePath(picture, segment, sampler, most, active), factor

    def _lights(self, picture: Picture, positions: Any, seed: int) -> Any:
        emitters, scene = self._table.moving_emitters(picture.scene), picture.scene
        index, point, segment, eye, factor = self._draw(picture, positions, seed, self._max_depth - 2, emitters)
        with dr.suspend_grad():
            origin, jump = mi.Point3f(eye.first.spawn_ray(segment.direction).o), mi.Spectrum(0)
            for target, sign in ((segment.inside, 1.0), (segment.outside, -1.0)):
                distance = dr.norm(target - origin)
                towards = mi.Vector3f(target - origin) / distance
                si = scene.ray_intersect(mi.Ray3f(origin, towards, eye.time), eye.active)
                emitter = si.emitter(scene, eye.active)
                own = eye.active & (registry_id(emitter) == dr.gather(mi.UInt32, emitters, index))
                own &= dr.abs(si.t - distance) < _OWN * distance
                jump += sign * dr.select(own, emitter.eval(si, own), 0)
            jump *= eye.throughput * factor
        with dr.resume_grad():
            return picture.collect(jump, eye.position, eye.active, dr.dot(segment.normal, point))

    def _indirect(self, picture: Picture, positions: Any, seed: int) -> Any:
        _, point, segment, eye, factor = self._draw(picture, positions, seed, self._max_depth - 3)
        with dr.suspend_grad():
            L, far = self._both_sides(picture.scene, segment, eye, seed ^ 0x9E3779B9)
            near = dr.norm(segment.point - eye.first.p)
            parts = []
            for side, sign in ((0, 1.0), (1, -1.0)):
                ratio = dr.select(dr.isfinite(far[side]), dr.maximum(far[side] - near, 0) / far[side], 1)
                parts.append((eye.throughput * L[side] * (sign * factor), ratio))
        with dr.resume_grad():
            total = mi.Float(0)
            for value, ratio in parts:
                motion = dr.dot(segment.normal, point - ratio * eye.moved)
                total += picture.collect(value, eye.position, eye.active, motion)
            return total

    def _both_sides(self, scene: Any, segment: BoundarySegment, eye: EyePath, seed: int) -> tuple[list[Any], list[Any]]:
        """Return the reflected radiance that arrives at x_a from the inner and the outer side of an edge, and the distances of both
        hits."""
        count = dr.width(segment.point)
        number = dr.arange(mi.UInt32, 2 * count)
        lane = number % count
        target = dr.select(
            number < count, dr.gather(mi.Point3f, segment.inside, lane), dr.gather(mi.Point3f, segment.outside, lane)
        )
        active = dr.gather(mi.Bool, eye.active, lane)
        origin = dr.gather(mi.Point3f, mi.Point3f(eye.first.spawn_ray(segment.direction).o), lane)
        ray = mi.Ray3f(origin, dr.normalize(target - origin), eye.time)  # pyright: ignore[reportArgumentType, reportCallIssue]
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
        """Return the radiance along rays that hit `si` after `depth` segments. Lanes `period` apart share random numbers."""
        sampler = lane_sampler(seed, period, dr.width(ray.o))
        with dr.suspend_grad():
            return self._radiance.sample(dr.ADMode.Primal, scene, sampler, ray, depth, None, None, active, False, si)[0]


def _facing(si: Any, ray: Any, distance: Any) -> Any:
    """Flip the shading normal of back-facing interactions that are about as far as an edge towards the viewer.

    Interpolated normals point away from the viewer in the last triangles before a silhouette, which are black. The inner border of this
    rim moves with the silhouette, so its jump is merged with the silhouette's.
    """
    cosine = dr.dot(si.sh_frame.n, ray.d)
    flipped = si.is_valid() & (cosine > -1e-4) & (dr.dot(si.n, ray.d) < 0)
    flipped &= dr.abs(si.t - distance) < 0.05 * distance
    normal = dr.normalize(si.sh_frame.n - (cosine + 1e-4) * ray.d)
    frame = mi.Frame3f(normal)
    si.sh_frame = dr.select(flipped, frame, si.sh_frame)
    si.wi = dr.select(flipped, si.to_local(-ray.d), si.wi)
    return si


def _halves_difference(L: Any, count: int) -> Any:
    dr.eval(L)
    lane = dr.arange(mi.UInt32, count)
    return mi.Spectrum(*(dr.gather(mi.Float, L[c], lane) - dr.gather(mi.Float, L[c], lane + count) for c in range(3)))
