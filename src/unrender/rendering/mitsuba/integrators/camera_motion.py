"""Derivative of an image by the motion of its sensor.

A point x is at P(x; θ) on the film, where θ are the sensor's pose and field of view. Along the flow v = ∂P/∂θ of the visible points,
the image f only changes with the direction of view. Reynolds' transport theorem therefore gives

    d/dθ ∫ k f du = ∫ f v·∇k du + ∫ k f div v du + ∫ k Df du + Σ over silhouettes ∫ k [f (v − s)·n] ds

with the reconstruction filter k of the pixel (∇k is on the pixel's border for a box filter), the divergence of the flow, and the change
Df of f at fixed points. The silhouettes are curves where the flow is discontinuous. They move by s and have different f and v on both
sides. Shadows and textures are part of f and need no edges. If a sensor rotates or zooms, the flow depends on u alone: Df and the
silhouette term vanish in every scene.

The radiance where a filter increases, where it decreases, and inside, uses the same random numbers, so noise cancels between them. In
flat mirrors the flow is that of the virtual image of the mirrored point.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba.edges import EdgeTable
from unrender.rendering.mitsuba.film import ViewWeights
from unrender.rendering.mitsuba.integrators.boundary_paths import OFFSET, WeightedPicture
from unrender.rendering.mitsuba.integrators.boundary_sampling import WeightedChoice, lane_sampler
from unrender.rendering.mitsuba.integrators.flat_mirrors import FlatMirrors, MirroredView, glossy_radiance, is_glossy
from unrender.rendering.mitsuba.pixel_filter import FilterSlopes, PixelFilters, is_box

_ARCS = 16  # number of pieces of a curve, which are sampled by their lengths in the image
_SPHERE, _CIRCLE, _TOP, _LEFT, _RIGHT = range(5)
"""Kinds of curves in local coordinates: silhouette of a unit sphere, unit circles at z = 0 and z = 1, and the two silhouette lines of the
cylinder between them."""
_CURVES = {"Sphere": (_SPHERE,), "Disk": (_CIRCLE,), "Cylinder": (_CIRCLE, _TOP, _LEFT, _RIGHT)}


class SilhouetteCurves:
    """Silhouette curves of a scene that does not move, in `count` pieces: of meshes, spheres, disks and cylinders."""

    @staticmethod
    def omitted(scene: Any) -> list[str]:
        """Return the classes of the scene's shapes whose silhouettes are not included."""
        shapes = [shape for shape in scene.shapes() if not shape.is_mesh()]
        return sorted({shape.class_name() for shape in shapes} - _CURVES.keys())

    def __init__(self, scene: Any, table: EdgeTable):
        self._table = table
        self._positions = dr.detach(table.positions(scene)) if table.count else mi.Float(0)
        rows, kinds = [], []
        for shape in scene.shapes():
            for kind in _CURVES.get(shape.class_name(), ()):
                matrix: Any = mi.traverse(shape)["to_world"]
                kinds.append(kind)
                rows.append(np.array(matrix.matrix).reshape(4, 4)[:3])
        self._kinds = mi.UInt32(kinds or [0])
        self._matrices = mi.Float(np.array(rows or np.zeros((1, 3, 4)), np.float32).reshape(-1))
        self.count = table.count + _ARCS * len(kinds)

    def at(self, index: Any, u: Any, viewpoint: Any) -> tuple[Any, Any, Any]:
        """Return points at u in [0, 1] along these pieces, their derivatives by u, and whether the view of `viewpoint` may be
        discontinuous there."""
        viewpoint = mi.Point3f(viewpoint)
        if self._table.count == 0:
            return self._analytic(index, u, viewpoint)
        of_mesh = index < self._table.count
        edge = self._table.at(self._positions, dr.minimum(index, self._table.count - 1))
        point, along = dr.lerp(edge.start, edge.end, u), edge.end - edge.start
        result = mi.Point3f(point), mi.Vector3f(along), edge.is_silhouette(viewpoint - 0.5 * (edge.start + edge.end))
        if self.count > self._table.count:
            others = self._analytic(dr.select(of_mesh, 0, index - self._table.count), u, viewpoint)
            result = tuple(dr.select(of_mesh, a, b) for a, b in zip(result, others, strict=True))
        return result

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
        # The silhouette of a sphere is the circle of points x with x · v = 1.
        distance = dr.norm(local)
        axis = local / dr.maximum(distance, 1e-20)
        frame = mi.Frame3f(axis)
        size = dr.safe_sqrt(1 - dr.rcp(dr.maximum(dr.square(distance), 1e-20)))
        sphere = kind == _SPHERE
        point = dr.select(sphere, axis / dr.maximum(distance, 1e-20) + size * (c * frame.s + s * frame.t), point)
        along = dr.select(sphere, size * dr.two_pi * (c * frame.t - s * frame.s), along)
        exists &= ~sphere | (distance > 1)
        # The silhouette lines of a cylinder are at angles from the viewpoint with cosine 1 / distance.
        flat = dr.sqrt(dr.square(local.x) + dr.square(local.y))
        line = (kind == _LEFT) | (kind == _RIGHT)
        angle = dr.safe_acos(dr.rcp(dr.maximum(flat, 1e-20))) * dr.select(kind == _LEFT, -1.0, 1.0)
        ls, lc = dr.sincos(dr.atan2(local.y, local.x) + angle)
        point = dr.select(line, mi.Vector3f(lc, ls, t), point)
        along = dr.select(line, mi.Vector3f(0, 0, 1), along)
        exists &= ~line | (flat > 1)
        return mi.Point3f(linear @ point + shift), mi.Vector3f(linear @ along) / _ARCS, exists


_POINTS = 5
"""Points per sample: two per coordinate where the pixel's filter increases and decreases (opposite borders of a box), and one inside."""


class _ViewSample:
    """Radiance of a lane's view ray, and its visible point in homogeneous coordinates with derivatives along the surface by both film
    coordinates. Detached."""

    def __init__(self, L: Any, point: Any, across: tuple[Any, Any]):
        self.L, self.point, self.across = L, point, across


class _Points:
    """Film coordinates, and the derivatives and the value of the pixel's filter there, over their densities."""

    def __init__(self, uv: Any, slope: Any, within: Any):
        self.uv, self.slope, self.within = uv, slope, within


class _FilmMap:
    """Projection of points to the film, attached to the sensor's parameters. Film coordinates range from 0 to 1."""

    def __init__(self, sensor: Any):
        with dr.resume_grad():
            matrix = sensor.projection_transform().matrix @ sensor.world_transform().inverse().matrix
            offset, film = mi.traverse(sensor), sensor.film()
            centre = [mi.Float(offset[f"principal_point_offset_{axis}"]) for axis in "xy"]
            full_size, size = film.size(), film.crop_size()
            self._shift = [centre[k] * dr.opaque(mi.Float, float(full_size[k]) / float(size[k])) for k in range(2)]
            self._rows = [mi.Vector4f(*(matrix[row, column] for column in range(4))) for row in range(4)]
        with dr.suspend_grad():
            self.origin = dr.detach(sensor.world_transform()) @ mi.Point3f(0)
            inverse = dr.rcp(dr.detach(matrix))
            self._columns = [mi.Vector4f(*(inverse[row, column] for row in range(4))) for column in range(4)]

    def direction(self, uv: Any) -> tuple[Any, Any, Any]:
        """Return the unnormalised direction of the ray through `uv` and its derivatives by both coordinates. Detached."""
        x, y, _, one = self._columns
        near = (uv.x + dr.detach(self._shift[0])) * x + (uv.y + dr.detach(self._shift[1])) * y + one
        columns = [mi.Vector3f(v.x, v.y, v.z) / near.w for v in (near, x, y)]
        return columns[0] - mi.Vector3f(self.origin), columns[1], columns[2]

    def place(self, point: Any) -> Any:
        """Project homogeneous points."""
        w = dr.dot(self._rows[3], point)
        return mi.Vector2f(
            dr.dot(self._rows[0], point) / w - self._shift[0], dr.dot(self._rows[1], point) / w - self._shift[1]
        )

    def stretch(self, sample: _ViewSample) -> Any:
        """Return the Jacobian determinant of the map from the current film to the moved film, along the visible surface: 1, with
        derivative div v."""
        w, (x, y) = dr.dot(self._rows[3], sample.point), (dr.dot(row, sample.point) for row in self._rows[:2])
        columns = []
        for across in sample.across:
            change = dr.dot(self._rows[3], across)
            columns.append(tuple((dr.dot(self._rows[k], across) - v * change / w) / w for k, v in ((0, x), (1, y))))
        (a, b), (c, d) = columns
        return a * d - b * c


class CameraMotion:
    """Derivatives of a perspective sensor's image by its own pose and field of view; `table` is None if its position does not change. If
    the scene is `still`, curves and mirrors are computed only once."""

    # This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
    def __init__(self, table: EdgeTable | None, max_depth: int, still: bool):
        self._table, self._max_depth, self._still = table, max_depth, still
        self._mirrors: Any = None
        self._curves: Any = None
        self._filters: Any = None
        self._radiance: Any = mi.load_dict({"type": "prb_projective", "max_depth": max_depth, "rr_depth": max_depth})

    def weighted_image(self, scene: Any, sensor: Any, view: ViewWeights, seed: int) -> Any:
        """Return a value whose derivative equals that of Σ weights · image, attached to the sensor's parameters.

        It is unbiased, except for the views through curved mirrors and glass if the sensor's position changes.
        """
        if self._mirrors is None or not self._still:
            self._mirrors = FlatMirrors(scene)
            self._curves = SilhouetteCurves(scene, self._table) if self._table is not None else None
        film = _FilmMap(sensor)
        picture = WeightedPicture(scene, sensor, view.image, view.samples)
        total = self._pixels(picture, film, view, seed)
        if self._curves is not None:
            if self._curves.count:
                total += self._silhouettes(self._curves, picture, film, seed ^ 0x5BD1E995)
            if self._max_depth >= 2 and is_glossy(scene):
                total += self._directions(picture, view, seed ^ 0x1B873593)
        return total

    # ------------------------------------------------------------------ pixels and their borders

    def _pixels(self, picture: WeightedPicture, film: _FilmMap, view: ViewWeights, seed: int) -> Any:
        count = picture.samples
        with dr.suspend_grad():
            number = dr.arange(mi.UInt32, _POINTS * count)
            kind, lane = number // count, number % count
            index = lane // view.spp
            points = self._points(picture, view, index, kind, lane_sampler(seed, count, _POINTS * count).next_2d())
            sample = self._sample_view(picture, film, points.uv, mi.Bool(True), seed ^ 0x9E3779B9, count)
            weighted = mi.Float(0)
            for c in range(3):
                weighted += sample.L[c] * dr.gather(mi.Float, view.values, index * 3 + c)
            dr.eval(weighted)
            border: Any = mi.Vector2f(*(weighted * points.slope[axis] * picture.size[axis] for axis in range(2)))
            within = weighted * points.within
        with dr.resume_grad():
            total = dr.sum(dr.dot(border, film.place(sample.point)) + within * film.stretch(sample))
            return total * dr.opaque(mi.Float, 1 / view.spp)

    def _points(self, picture: WeightedPicture, view: ViewWeights, index: Any, kind: Any, u: Any) -> _Points:
        """Return the five points of a sample: where its pixel's filter increases and decreases along x, along y, and one inside."""
        number = dr.gather(mi.UInt32, view.pixels, index)
        row = number // picture.width
        pixel = mi.Point2u(number - row * picture.width, row)
        one = dr.select(kind == _POINTS - 1, 1.0, 0.0)
        signs = [dr.select(kind == axis * 2, 1.0, dr.select(kind == axis * 2 + 1, -1.0, 0.0)) for axis in range(2)]
        if is_box(picture.sensor.film()):
            places = [dr.select(signs[axis] == 0, u[axis], 0.5 - 0.5 * signs[axis]) for axis in range(2)]
            return _Points((mi.Vector2f(pixel) + mi.Vector2f(*places)) / picture.size, mi.Vector2f(*signs), one)
        if self._filters is None:
            self._filters = PixelFilters.of([picture.sensor]), FilterSlopes(picture.sensor.film())
        filters, slopes = self._filters
        places, weights, masses = [], [], []
        for axis, size in enumerate((picture.width, picture.height)):
            place, weight = filters.sample(u[axis], pixel[axis], size, mi.UInt32(0))
            rise, fall, mass = slopes.sample(u[axis], pixel[axis], size)
            places.append(dr.select(signs[axis] > 0, rise, dr.select(signs[axis] < 0, fall, place)) + 0.5)
            weights.append(weight)
            masses.append(mass)
        slope = [signs[axis] * masses[axis] * weights[1 - axis] for axis in range(2)]
        uv = (mi.Vector2f(pixel) + mi.Vector2f(*places)) / picture.size
        return _Points(uv, mi.Vector2f(*slope), one * weights[0] * weights[1])

    def _sample_view(
        self, picture: WeightedPicture, film: _FilmMap, uv: Any, active: Any, seed: int, period: int
    ) -> _ViewSample:
        """Return the view through `uv`. Lanes `period` apart share random numbers."""
        sensor, scene = picture.sensor, picture.scene
        ray, weight = sensor.sample_ray(picture.time, 0.5, mi.Point2f(uv), mi.Point2f(0.5), active)
        si = scene.ray_intersect(ray, active)
        view = MirroredView(si, mi.Ray3f(ray), dr.norm(si.p - film.origin), self._max_depth)
        if self._mirrors:
            view.follow(scene, active)
        L = self._trace(scene, view.ray, view.si, view.depth, active, seed, period) * weight * view.β
        towards, across, down = film.direction(uv)
        valid = view.si.is_valid()
        inverse = dr.select(valid, dr.norm(towards) / view.distance, 0)
        n = mi.Vector3f(view.linear.T @ mi.Vector3f(view.si.n))
        height = dr.dot(n, towards)
        tilted = valid & (dr.abs(height) > 1e-6 * dr.norm(towards))
        slopes = [dr.select(tilted, inverse * dr.dot(n, v) / height, 0) for v in (across, down)]
        origin = mi.Vector3f(film.origin)
        tangents = [_homogeneous(origin * slope + v, slope) for v, slope in zip((across, down), slopes, strict=True)]
        return _ViewSample(
            dr.select(active, L, 0), _homogeneous(origin * inverse + towards, inverse), (tangents[0], tangents[1])
        )

    def _trace(self, scene: Any, ray: Any, si: Any, depth: Any, active: Any, seed: int, period: int) -> Any:
        sampler = lane_sampler(seed, period, dr.width(ray.d))
        return self._radiance.sample(dr.ADMode.Primal, scene, sampler, ray, depth, None, None, active, False, si)[0]

    def _directions(self, picture: WeightedPicture, view: ViewWeights, seed: int) -> Any:
        """Return ∫ Df du: the change of radiance at fixed points with the direction to the sensor."""
        sensor, scene, count = picture.sensor, picture.scene, picture.samples
        with dr.suspend_grad():
            sampler = lane_sampler(seed, count, count)
            index = dr.arange(mi.UInt32, count) // view.spp
            within = self._points(picture, view, index, mi.UInt32(_POINTS - 1), sampler.next_2d())
            ray, weight = sensor.sample_ray(picture.time, 0.5, mi.Point2f(within.uv), mi.Point2f(0.5), True)
            si = scene.ray_intersect(ray)
            weight *= within.within * mi.Spectrum(*(dr.gather(mi.Float, view.values, index * 3 + c) for c in range(3)))
            active = si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Glossy)
        with dr.resume_grad():
            viewpoint = sensor.world_transform() @ mi.Point3f(0)
            towards = si.to_local(dr.normalize(viewpoint - si.p))
        lit = glossy_radiance(scene, si, towards, sampler, self._trace_on, active)
        with dr.resume_grad():
            return dr.sum(dr.dot(weight, lit)) * dr.opaque(mi.Float, 1 / view.spp)

    def _trace_on(self, scene: Any, ray: Any, si: Any, sampler: Any, active: Any) -> Any:
        return self._radiance.sample(
            dr.ADMode.Primal, scene, sampler, ray, mi.UInt32(1), None, None, active, False, si
        )[0]

    # ------------------------------------------------------------------ silhouettes

    def _silhouettes(self, curves: SilhouetteCurves, picture: WeightedPicture, film: _FilmMap, seed: int) -> Any:
        scene, count = picture.scene, picture.samples
        with dr.suspend_grad():
            mirrors = self._mirrors
            number = dr.arange(mi.UInt32, curves.count * mirrors.count)
            viewpoint = mirrors.reflect(film.origin, number // curves.count)
            middle, along, jumps = curves.at(number % curves.count, 0.5, viewpoint)
            chosen = WeightedChoice(dr.select(jumps, dr.norm(along) / dr.norm(middle - viewpoint), 0))
            sampler = lane_sampler(seed, count, count)
            number, pmf = chosen.draw(sampler.next_1d())
            mirror = number // curves.count
            viewpoint = mirrors.reflect(film.origin, mirror)
            real, along, jumps = curves.at(number % curves.count, sampler.next_1d(), viewpoint)
            point, along = mirrors.reflect(real, mirror), mirrors.reflect(along, mirror, direction=True)
            uv, depth = picture.project(point)
            along = picture.project_motion(point, uv, along)
            length = dr.norm(along)
            normal = mi.Vector2f(-along.y, along.x) / dr.maximum(length, 1e-20)
            start, beyond = picture.near_point(film.origin, point, depth)
            active = (pmf > 0) & jumps & (length > 1e-12) & beyond & picture.stencil.is_sampled(uv)
            active &= self._mirrors.sees(scene, start, real, point, mirror, active)
            factor = dr.select(active, length / pmf * picture.scale, 0)
            # Evaluate both sides of the curve with equal random numbers.
            number = dr.arange(mi.UInt32, 2 * count)
            lane = number % count
            sign = dr.select(number < count, -1.0, 1.0)
            active, normal, point = (dr.gather(type(v), v, lane) for v in (active, normal, mi.Point3f(point)))
            uv = dr.gather(mi.Vector2f, mi.Vector2f(uv), lane)
            shifted = uv + mi.Vector2f(normal) * (OFFSET * sign)
            sample = self._sample_view(picture, film, shifted, active, seed ^ 0x9E3779B9, count)
            weighted = picture.weighted(sample.L, uv * picture.size, active)
            scale = dr.gather(mi.Float, factor, lane) * weighted * sign
            dr.eval(scale, normal, point)
        with dr.resume_grad():
            relative = film.place(sample.point) - film.place(_homogeneous(point, 1.0))
            return dr.sum(scale * dr.dot(normal, relative))


def _homogeneous(v: Any, w: Any) -> Any:
    return mi.Vector4f(v.x, v.y, v.z, w)
