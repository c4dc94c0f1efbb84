"""Flat perfect mirrors, whose virtual images do not move with the viewer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba import mesh_layout
from unrender.rendering.mitsuba.integrators.emitters import mis_weight

_NEAR = 1e-3  # relative margin at the end of a shadow ray within which occluders are ignored
_BOUNCES = 2  # maximum number of reflections by flat mirrors
_PLANES = 12  # maximum number of mirror planes with virtual edges


class FlatMirrors:
    """The flat mirrors of a scene, False if there are none. It has `count` views: index 0 without a mirror, and one for each mirror
    plane."""

    # This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
    def __init__(self, scene: Any):
        planes: list[np.ndarray] = []
        for shape in scene.shapes():
            if shape.is_mesh() and _reflects(shape.bsdf().flags()):
                for plane in _planes(shape):
                    if not any(np.allclose(plane, known, atol=1e-5) for known in planes):
                        planes.append(plane)
        self._any = bool(planes)
        rows = np.concatenate([np.zeros((1, 4)), np.reshape(planes[:_PLANES], (-1, 4))])
        self.count = len(rows)
        self._rows = mi.Float(rows.astype(np.float32).reshape(-1))

    def __bool__(self) -> bool:
        return self._any

    def _plane(self, number: Any) -> tuple[Any, Any]:
        v = [dr.gather(mi.Float, self._rows, number * 4 + k) for k in range(4)]
        return mi.Vector3f(v[0:3]), v[3]

    def reflect(self, point: Any, number: Any, direction: bool = False) -> Any:
        """Reflect points, or directions, in the mirror of this index; index 0 returns them unchanged."""
        n, height = self._plane(number)
        v = mi.Vector3f(point)
        v -= 2 * (dr.dot(n, v) - (0 if direction else height)) * n
        return v if direction else mi.Point3f(v)

    def sees(self, scene: Any, origin: Any, real: Any, virtual: Any, number: Any, active: Any) -> Any:
        """Return whether the origin sees a point, directly or by the mirror of this index."""
        n, height = self._plane(number)
        towards = mi.Vector3f(virtual - origin)
        ray = mi.Ray3f(origin, dr.normalize(towards))
        ray.maxt = dr.norm(towards) * (1 - _NEAR)
        plain = number == 0
        if not self._any:
            return active & ~scene.ray_test(ray, active)
        si = scene.ray_intersect(ray, active)
        free = active & plain & ~si.is_valid()
        meets = active & ~plain & si.is_valid() & _is_flat_mirror(si)
        meets &= dr.abs(dr.dot(n, si.p) - height) < 1e-4 * (1 + dr.abs(height))
        beyond = si.spawn_ray_to(real)
        beyond.maxt = beyond.maxt * (1 - _NEAR)
        return free | (meets & ~scene.ray_test(beyond, meets))


class MirroredView:
    """View ray through flat mirrors: the surface it hits, the ray, its length from the viewer, and the orientation of the image.

    Attributes:
        si: `mi.SurfaceInteraction3f`.
        ray: last segment.
        distance: length of all segments.
        depth: number of segments before the last.
        linear: `mi.Matrix3f`, from directions of the virtual image to those of the world.
    """

    # This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
    def __init__(self, si: Any, ray: Any, distance: Any, max_depth: int):
        self.si, self.ray, self.distance = si, ray, distance
        self.depth, self.β, self.linear = mi.UInt32(0), mi.Spectrum(1), mi.Matrix3f(dr.identity(mi.Matrix3f))
        self._max_depth = max_depth

    def follow(self, scene: Any, active: Any) -> None:
        """Follow the ray to the first surface other than a flat mirror, within two reflections."""
        for _ in range(_BOUNCES):
            si = self.si
            turns = active & si.is_valid() & _is_flat_mirror(si) & (self.depth + 1 < self._max_depth)
            bs, weight = si.bsdf().sample(mi.BSDFContext(), si, 0.5, mi.Point2f(0.5), turns)
            turns &= dr.any(weight != 0)
            ray = si.spawn_ray(si.to_world(bs.wo))
            n = mi.Vector3f(si.n)
            columns = [mi.Vector3f(*(self.linear[row, column] for row in range(3))) for column in range(3)]
            mirrored = [v - 2 * dr.dot(n, v) * n for v in columns]
            matrix = mi.Matrix3f(*(mirrored[column][row] for row in range(3) for column in range(3)))
            following = scene.ray_intersect(ray, turns)
            self.distance = dr.select(turns, self.distance + following.t, self.distance)
            self.linear = dr.select(turns, matrix, self.linear)
            self.β = dr.select(turns, self.β * weight, self.β)
            self.depth = dr.select(turns, self.depth + 1, self.depth)
            self.ray = dr.select(turns, ray, self.ray)
            self.si = dr.select(turns, following, si)


def _reflects(flags: Any) -> Any:
    """Return whether a BSDF only has a perfect mirror lobe."""
    reflects = mi.has_flag(flags, mi.BSDFFlags.DeltaReflection)
    others = [mi.BSDFFlags.Smooth, mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.Null]
    for flag in others:
        reflects = reflects & (mi.has_flag(flags, flag) == False)  # noqa: E712 (per lane)
    return reflects


def _is_flat_mirror(si: Any) -> Any:
    flat = si.shape.is_mesh() & (dr.squared_norm(mi.Vector3f(si.sh_frame.n) - mi.Vector3f(si.n)) < 1e-8)
    return flat & _reflects(si.bsdf().flags())


def _planes(mesh: Any) -> list[np.ndarray]:
    """Return normal and offset (4,) of the planes of a mesh's faces; empty if the mesh has many faces."""
    points = np.array(mesh_layout.positions(mesh), float).reshape(-1, 3)
    faces = np.array(mesh_layout.faces(mesh)).reshape(-1, 3).astype(np.int64)
    if len(faces) > 2 * _PLANES:
        return []
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = (normals / np.maximum(size, 1e-20))[size[:, 0] > 0]
    planes = np.c_[normals, (normals * a[size[:, 0] > 0]).sum(axis=1)]
    # Both sides of a plane are one mirror, so make the largest component of its normal positive.
    largest = np.take_along_axis(normals, np.abs(normals).argmax(axis=1)[:, None], axis=1)
    return list(planes * np.where(largest < 0, -1.0, 1.0))


def is_glossy(scene: Any) -> bool:
    """Return whether a BSDF of the scene has a glossy lobe. Other lobes, except perfect mirrors, do not depend on the direction of view."""
    return any(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Glossy) for shape in scene.shapes())


def glossy_radiance(
    scene: Any, si: Any, towards: Any, sampler: Any, trace: Callable[[Any, Any, Any, Any, Any], Any], active: Any
) -> Any:
    """Return 0, with the derivative of the reflected radiance by the direction of view, without perfectly specular lobes.

    The result is the radiance minus itself at the detached direction. Derivatives by the material, which path replay includes, cancel.
    `towards` is the direction in the frame of `si`, attached, and `trace` the radiance along a ray that hits an interaction.
    """
    context = mi.BSDFContext()
    with dr.suspend_grad():
        bsdf, viewed = si.bsdf(), mi.SurfaceInteraction3f(si)
        ds, emitted = scene.sample_emitter_direction(si, sampler.next_2d(), True, active)
        to_emitter = si.to_local(ds.d)
        lit = active & (ds.pdf > 0)
        density = bsdf.pdf(context, si, to_emitter, lit)
        emitted *= dr.select(ds.delta, 1, mis_weight(ds.pdf, density))
        bs, _ = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
        smooth = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        density = bsdf.pdf(context, si, bs.wo, smooth)
        smooth &= density > 0
        ray = si.spawn_ray(si.to_world(bs.wo))
        following = scene.ray_intersect(ray, smooth)
        arriving = trace(scene, ray, following, sampler, smooth)
        hit = mi.DirectionSample3f(scene, following, si)
        direct = following.emitter(scene, smooth).eval(following, smooth)
        mis = mis_weight(density, scene.pdf_emitter_direction(si, hit, smooth))
        arriving += direct * (mis - 1)
        arriving = dr.select(smooth, arriving / density, 0)
    with dr.resume_grad():
        viewed.wi = towards
        from_emitter = bsdf.eval(context, viewed, to_emitter, lit) - bsdf.eval(context, si, to_emitter, lit)
        others = bsdf.eval(context, viewed, bs.wo, smooth) - bsdf.eval(context, si, bs.wo, smooth)
        return from_emitter * emitted + others * arriving
