"""Paths through an edge of a mesh: the sensor's picture, the segment through the edge, and the subpath to the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.edges import EdgePoints
from unrender.rendering.mitsuba.pixel_filter import FilterStencil

OFFSET = 1e-4
"""Offset to the two sides of an edge, relative to the picture's side or, in space, to 1 + the largest coordinate."""


class Picture:
    """A perspective sensor's film, which collects the contributions of `samples` boundary samples to its pixels' derivatives."""

    def __init__(self, scene: Any, sensor: Any, samples: int):
        size = sensor.film().crop_size()
        self.stencil = FilterStencil(sensor.film())
        self.scene, self.sensor, self.samples = scene, sensor, samples
        self.width, self.height = int(size[0]), int(size[1])
        self.size = mi.Vector2f(self.width, self.height)
        # Opaque, since the number of samples in a mini-batch varies between steps and would change the kernels.
        self.scale = dr.opaque(mi.Float, self.width * self.height / samples)
        self.time: Any = dr.opaque(mi.Float, float(sensor.shutter_open()))
        self._near: Any = dr.opaque(mi.Float, float(sensor.near_clip()))
        with dr.suspend_grad():
            matrix = dr.detach(sensor.projection_transform().matrix) @ dr.detach(
                sensor.world_transform().inverse().matrix
            )
        # The projection matrix does not include the principal point offset, which shifts the film.
        offset = mi.traverse(sensor)
        full_size = mi.Vector2f(sensor.film().size())
        centre = [offset[f"principal_point_offset_{axis}"] for axis in "xy"]
        self._shift = mi.Vector2f(*(dr.detach(mi.Float(c)) for c in centre)) * full_size / self.size
        self._rows = [mi.Vector4f(*(matrix[row, column] for column in range(4))) for row in range(4)]

    def _row(self, number: int, v: Any, last: float) -> Any:
        row = self._rows[number]
        return row.x * v.x + row.y * v.y + row.z * v.z + row.w * last

    def project(self, point: Any) -> tuple[Any, Any]:
        """Return the positions of points on the film, from 0 to 1, and their depth along the viewing direction."""
        p = dr.detach(point)
        w = self._row(3, p, 1.0)
        uv = mi.Vector2f(self._row(0, p, 1.0), self._row(1, p, 1.0)) / w - self._shift
        return mi.Point2f(uv), w

    def near_point(self, camera: Any, point: Any, depth: Any) -> tuple[Any, Any]:
        """Return where the ray from the camera to a point of this depth begins, on the near clipping plane, and whether the point is
        beyond it."""
        start = camera + (mi.Point3f(point) - camera) * (self._near / dr.maximum(depth, self._near))
        return mi.Point3f(start), depth > self._near

    def project_motion(self, point: Any, uv: Any, motion: Any) -> Any:
        """Return the motion on the film of points at `uv` that move in space."""
        w = self._row(3, dr.detach(point), 1.0)
        x, y, change = (self._row(number, motion, 0.0) for number in (0, 1, 3))
        uv = uv + self._shift
        return mi.Vector2f(x - uv.x * change, y - uv.y * change) / w

    def collect(self, value: Any, position: Any, active: Any, motion: Any) -> Any:
        """Add samples, whose contribution to their pixels' derivatives is value (detached, over the density) times the derivative of
        motion.

        The position is on the film, in pixels, and `motion` is attached to the meshes' positions. Returns `mi.Float` of width 1, attached
        to the positions in backward mode. Callers add the returned values.
        """
        raise NotImplementedError


class WeightedPicture(Picture):
    """Picture for backward mode, which sums all pixels times their weights (H, W, 3)."""

    def __init__(self, scene: Any, sensor: Any, weights: Any, samples: int):
        super().__init__(scene, sensor, samples)
        self._weights = weights.array

    def weighted(self, value: Any, position: Any, active: Any) -> Any:
        """Return Σ over pixels and channels of value times filter times weight, for samples at `position` in pixels."""
        weights = mi.Color3f(0)

        def add(pixel: Any, factor: Any, inside: Any) -> None:
            for c in range(3):
                weights[c] += factor * dr.gather(mi.Float, self._weights, pixel * 3 + c, active & inside)

        self.stencil.add(position, add)
        return dr.dot(mi.Color3f(value), weights)

    def collect(self, value: Any, position: Any, active: Any, motion: Any) -> Any:
        with dr.suspend_grad():
            weighted = dr.select(active, self.weighted(value, position, active), 0)
        return self.scale * dr.sum(weighted * motion)


class TangentPicture(Picture):
    """Picture for forward mode: each pixel's derivative along the tangents of the meshes' positions."""

    def __init__(self, scene: Any, sensor: Any, samples: int):
        super().__init__(scene, sensor, samples)
        self._sums = dr.zeros(mi.Float, self.width * self.height * 3)

    def collect(self, value: Any, position: Any, active: Any, motion: Any) -> Any:
        """Add the samples to `image`, and return 0."""
        if dr.grad_enabled(motion):
            # Keep the graph's edges, since the two sides of a mesh edge share some of them.
            dr.forward_to(motion, flags=dr.ADFlag.ClearInterior)
            speed = dr.grad(motion) * self.scale
            with dr.suspend_grad():
                counts = active & dr.isfinite(speed)

                def add(pixel: Any, factor: Any, inside: Any) -> None:
                    for c in range(3):
                        dr.scatter_add(self._sums, value[c] * speed * factor, pixel * 3 + c, counts & inside)

                self.stencil.add(position, add)
        return mi.Float(0)

    def image(self) -> Any:
        """Return the derivative of the image, `mi.TensorXf` (H, W, 3)."""
        return mi.TensorXf(self._sums, (self.height, self.width, 3))


class BoundarySegment:
    """A direction through an edge point, and the normal, which points away from the first face. All detached."""

    def __init__(self, edge: EdgePoints, point: Any, direction: Any):
        start, end = dr.detach(edge.start), dr.detach(edge.end)
        self.point, self.direction = point, direction
        self.length = dr.norm(end - start)
        across = dr.cross(direction, (end - start) / dr.maximum(self.length, 1e-20))
        self.sine = dr.norm(across)
        self.valid = (self.length > 0) & (self.sine > 1e-6)
        across = across / dr.maximum(self.sine, 1e-20)
        self.normal = mi.Vector3f(dr.select(dr.dot(across, edge.third - point) > 0, -across, across))
        shift = self.shift = OFFSET * (1 + dr.max(dr.abs(point)))
        self._edge, self._along = edge, (end - start) / dr.maximum(self.length, 1e-20)
        self.outside = mi.Point3f(point + shift * self.normal)
        self.inside = mi.Point3f(point - shift * self.normal)

    def is_behind(self, origin: Any) -> Any:
        """Return whether a point lies on one of the edge's own faces, which occlude the segment if both are back-facing."""
        from_edge, behind = origin - self.point, mi.Bool(False)
        for third in (self._edge.third, self._edge.other_third):
            normal = dr.cross(self._along, third - self.point)
            height = dr.abs(dr.dot(normal, from_edge)) / dr.maximum(dr.norm(normal), 1e-20)
            behind |= height < 2 * self.shift
        return behind & (self._edge.crease | self._edge.always)


class EyePath:
    """Subpath from x_a, behind an edge point, to the sensor, with a random number `bounces` of intermediate vertices.

    `moved` is x_a as hit by a ray from the sensor's side, attached. The throughput is importance over density; the position is in pixels.
    """

    def __init__(self, picture: Picture, segment: BoundarySegment, sampler: Any, most: int, active: Any):
        scene = picture.scene
        with dr.suspend_grad():
            ray = mi.Ray3f(segment.outside, -segment.direction, picture.time)
            self.time = picture.time
            pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            active = active & si.is_valid() & ~segment.is_behind(si.p)
            self.first = si
            self.bounces, probability = _geometric(sampler.next_1d(), most)
            walk = _walk(scene, si, sampler, self.bounces, most, active)
            ds, importance = picture.sensor.sample_direction(walk.si, mi.Point2f(0.5), walk.active)
            active = walk.active & (ds.pdf > 0) & dr.any(importance > 0)
            to_sensor = walk.si.spawn_ray_to(picture.near_point(ds.p, walk.si.p, picture.project(walk.si.p)[1])[0])
            active &= ~scene.ray_test(to_sensor, active)
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
    """Scatter importance at x_a and at further vertices, `bounces` times."""
    state = _Walk(si, mi.Spectrum(1), mi.Vector3f(0, 0, 1), mi.UInt32(0), active)
    if most <= 0:
        return state
    context = mi.BSDFContext(mi.TransportMode.Importance)

    def is_going(state: _Walk, sampler: Any) -> Any:
        return state.active & (state.made < bounces)

    def bounce(state: _Walk, sampler: Any) -> tuple[_Walk, Any]:
        si, active = state.si, state.active
        bs, weight = si.bsdf().sample(context, si, sampler.next_1d(), sampler.next_2d(), active)  # pyright: ignore[reportArgumentType]
        direction = si.to_world(bs.wo)
        β = state.β * weight * _geometric_cosines(si, bs.wo, direction)
        following = scene.ray_intersect(si.spawn_ray(direction), mi.RayFlags.All, coherent=False, active=active)
        first = dr.select(state.made == 0, direction, state.first_direction)
        active &= following.is_valid() & dr.any(β != 0)
        return _Walk(following, β, first, state.made + 1, active), sampler

    result, _ = dr.while_loop((state, sampler), is_going, bounce, label="eye path")  # pyright: ignore[reportArgumentType, reportAssignmentType]
    # Paths that ended before their last bounce are inactive. The others keep their flag.
    result.active &= result.made == bounces
    return result


def _geometric_cosines(si: Any, wo: Any, direction: Any) -> Any:
    """Return the correction of shading normals for importance, which makes a BSDF's value times cosine adjoint to that of radiance
    (Veach 1997, section 5.3)."""
    incoming = dr.dot(si.n, si.to_world(si.wi))
    below = incoming * mi.Frame3f.cos_theta(wo)
    above = mi.Frame3f.cos_theta(si.wi) * dr.dot(si.n, direction)
    return dr.select(dr.abs(below) > 1e-12, dr.abs(above / below), 0)


def _geometric(sample: Any, most: int) -> tuple[Any, Any]:
    """Sample a number from 0 to `most` with probabilities that halve at each step, the last two equal. Return it with its probability."""
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
