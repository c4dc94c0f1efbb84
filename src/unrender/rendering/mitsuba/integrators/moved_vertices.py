"""Vertices of the paths of two states with moving shapes, images of a vertex in the other state, and rays that are equal in both.

Ellipsoids around moving shapes tell which rays are far from them. Symbols as in `path.py`; a subscript (ₚ) is the previous state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.base import (
    Bool,
    Float,
    ScatteringVertex,
    Spectrum,
    UInt32,
    registry_id,
    remap,
)
from unrender.rendering.mitsuba.integrators.emitters import mis_weight

_NUMBERS = 6  # numbers per ellipsoid
_THINNEST = 1e-2  # minimum half axis, relative to the longest half axis of the bounding box
_PADDING = 1e-4  # padding relative to the largest coordinate, larger than rounding errors of rays and bounds
_MARGIN = 1.01  # factor of the half axes, for the same reason


def bounding_ellipsoids(meshes: Sequence[Sequence[Any]]) -> Float:
    """Return the centre and the inverse half axes of an ellipsoid around each box of flat arrays of positions, all of which it contains: 6
    numbers each."""
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
    """Ellipsoids of `bounding_ellipsoids` in a kernel. This is not a dataclass, since Dr.Jit would treat a dataclass as loop state."""

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


@dataclass
class PathState:
    """Path of one state: the ray that leads to the vertex, the preliminary intersection there (not valid for rays without one), the last
    scattering vertex, radiance L so far, throughput β and relative index of refraction η. It is state of a Dr.Jit loop, hence mutable."""

    L: Spectrum
    β: Spectrum
    η: Float
    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    last: ScatteringVertex
    active: Bool

    def scatters(self) -> Bool:
        """Return the lanes whose path hits a surface."""
        return self.active & self.pi.is_valid()


@dataclass
class PairState:
    """Loop state of a pair of paths.

    Attributes:
        depth: number of segments traced.
        same: lanes whose vertices are the same point of a static shape, or where neither path hit anything.
    """

    depth: UInt32
    current: PathState
    previous: PathState
    same: Bool


@dataclass(frozen=True)
class Vertex:
    """Vertex of one state's path; emission there and the contribution of the sampled emitter point `to`, if visible, both times throughput.
    `active` are lanes whose path may continue."""

    si: Any
    bsdf: Any
    Le: Spectrum
    Ld: Spectrum
    to: Any
    active: Bool


@dataclass(frozen=True)
class Direction:
    """Sampled direction of one state's path at a vertex.

    Attributes:
        si, bsdf: surface interaction and BSDF.
        bs, weight: BSDF sample and its weight.
        delta: lanes that sampled a perfectly specular lobe.
        active: lanes that have a vertex where the path may continue.
    """

    si: Any
    bsdf: Any
    bs: mi.BSDFSample3f
    weight: Spectrum
    ray: Any
    delta: Bool
    active: Bool


@dataclass(frozen=True)
class Continuation:
    """Next segment of the previous state's path, of weight 0 if its vertex cannot be reached; `pdf` is the solid angle density of BSDF
    sampling alone. `same` are lanes whose next vertex is that of the current state's path, see `PairState`."""

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    weight: Spectrum
    pdf: Float
    delta: Bool
    η: Float
    same: Bool


class Link:
    """A path's vertex in one state, its image in the other state, and the reconnection of that state's path to the image.

    Images on meshes have the same barycentric coordinates. On other shapes, which are static, the ray determines them.

    Attributes:
        valid: lanes whose ray hit something. The ray of other lanes is connected to infinity.
        image: preliminary intersection of the image, and the distance to it.
        direction: direction to the image, from the last vertex of its state.
    """

    def __init__(
        self,
        tables: Mapping[str, Any],
        out: tuple[Direction, Direction],
        hits: tuple[Any, Any],
        reconnected: Bool,
        active: Bool,
    ):
        (now, before), (pi, piₚ) = out, hits
        hit = dr.select(reconnected, pi, piₚ)
        self._reconnected, self._triangle, self._from = (
            reconnected,
            hit.prim_index,
            dr.select(reconnected, now.ray, before.ray),
        )
        back = remap(tables["shape_back"], piₚ.shape)
        self._shape = dr.select(reconnected, pi.shape, back)
        self.valid = active & hit.is_valid()
        self.image = mi.PreliminaryIntersection3f(hit)
        self.image.shape = dr.select(reconnected, remap(tables["shape"], pi.shape), back)
        self._si = hit.compute_surface_interaction(self._from, mi.RayFlags.Minimal, self.valid)
        self._there: Any = self.image.compute_surface_interaction(self._from, mi.RayFlags.Minimal, self.valid)  # pyright: ignore[reportArgumentType]
        to = self._there.p - dr.select(reconnected, before.si.p, now.si.p)
        self._distance: Any = dr.norm(to)
        self.direction = dr.select(self.valid, to / self._distance, self._from.d)
        self.image.t = dr.select(self.valid, self._distance, hit.t)

    def ray(self, vertex: Any) -> Any:
        """Return the ray from the last vertex of the image's state to the image."""
        return dr.select(self.valid, vertex.spawn_ray_to(self._there.p), vertex.spawn_ray(self.direction))

    def density_ratio(self) -> Float:
        """Return the solid angle of a small area at the current state's point, seen from its path, over that at the previous state's
        point."""
        here = dr.abs_dot(self._si.n, self._from.d) / dr.square(self._si.t)
        there = dr.abs_dot(self._there.n, self.direction) / dr.square(self._distance)
        return dr.select(self._reconnected, here / there, there / here)

    def area_ratio(self, tables: Mapping[str, Any]) -> Float:
        """Return the area of the triangle in the current over that in the previous state."""
        first = dr.gather(mi.UInt32, tables["triangles"], registry_id(self._shape))
        return dr.rcp(dr.gather(mi.Float, tables["area_ratios"], dr.select(first > 0, first + self._triangle, 0)))


def moves(tables: Mapping[str, Any], shape: Any) -> Bool:
    """Return whether a shape of the current scene moves."""
    return dr.gather(mi.UInt32, tables["triangles"], registry_id(shape)) > 0


def is_clear(tables: Mapping[str, Any], ray: Any, pi: Any) -> Bool:
    """Return whether a ray of the current scene is far from moving shapes up to its hit. It then has the same hit in the previous scene."""
    return ~moves(tables, pi.shape) & ~tables["bounds"].meet(ray, pi.t)


def follow(
    sceneₚ: Any,
    tables: Mapping[str, Any],
    rays: tuple[Any, Any],
    pi: Any,
    clear: Bool,
    active: Bool,
    same: Bool,
    coherent: bool = False,
) -> tuple[Any, Bool]:
    """Intersect the previous state's ray. Rays that equal the current state's ray, without moving shapes nearby (`clear`), reuse its hit
    `pi`.

    `same` are lanes whose rays begin at one point, and whose `pi` is known; `coherent` tells that neighbouring rays are similar. Returns
    the hit, and lanes in which both rays hit the same point of a static shape, or nothing.
    """
    ray, rayₚ = rays
    equal = same & dr.all((ray.o == rayₚ.o) & (ray.d == rayₚ.d))
    known, shape = equal & clear, remap(tables["shape"], pi.shape)
    piₚ = sceneₚ.ray_intersect_preliminary(rayₚ, coherent=coherent, active=active & ~known)
    mapped = mi.PreliminaryIntersection3f(pi)
    mapped.shape = shape
    piₚ = dr.select(known, mapped, piₚ)
    one = ~pi.is_valid() & ~piₚ.is_valid()
    one |= pi.is_valid() & piₚ.is_valid() & (shape == piₚ.shape) & (pi.prim_index == piₚ.prim_index)
    return piₚ, equal & one & ~moves(tables, pi.shape)


def emission(scene: Any, path: PathState, si: Any) -> Spectrum:
    """Return the emission at a vertex, times the throughput and the MIS weight of hitting the emitter by BSDF sampling."""

    def emitted(at: tuple[PathState, Any]) -> Spectrum:
        path, si = at
        last = path.last
        ds = mi.DirectionSample3f(scene, si=si, ref=last.interaction)
        mis = mis_weight(last.pdf, scene.pdf_emitter_direction(last.interaction, ds, ~last.delta))
        return path.β * dr.select(last.delta, 1, mis) * ds.emitter.eval(si, path.active)

    shines: Any = path.active & (si.emitter(scene, path.active) != None)  # noqa: E711 (per lane)
    return dr.if_stmt(((path, si),), shines, emitted, lambda at: mi.Spectrum(0), label="emission")


def may_contribute(scene: Any, pi: Any) -> Bool:
    """Return the lanes whose next vertex may contribute: all with an environment, else those with a hit."""
    return mi.Bool(True) if scene.environment() is not None else pi.is_valid()


def is_diffuse(bsdf: mi.BSDFPtr) -> Bool:
    """Return whether a BSDF only has diffuse lobes."""
    flags = bsdf.flags()
    result = mi.has_flag(flags, mi.BSDFFlags.Diffuse)
    for kind in (mi.BSDFFlags.Delta, mi.BSDFFlags.Delta1D, mi.BSDFFlags.Glossy):
        result &= ~mi.has_flag(flags, kind)
    return result
