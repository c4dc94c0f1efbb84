"""What the paths of two states of a scene find whose shapes move: their vertices, a vertex's image in the other state, and which rays
find the same in both.

Symbols as in `path.py`; a subscript (ₚ) is the previous state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum, UInt32
from unrender.rendering.mitsuba.integrators.base import ScatteringVertex
from unrender.rendering.mitsuba.integrators.emitters import mis_weight
from unrender.rendering.mitsuba.integrators.pointer_tables import registry_id, remap


@dataclass
class PathState:
    """One state's path. State of a Dr.Jit loop, hence mutable.

    Attributes:
        L: radiance gathered so far.
        β: throughput.
        η: relative index of refraction.
        ray: on which the path has come to its vertex.
        pi: the primitive there; of rays that meet nothing, not valid.
        last: the vertex before.
        active: lanes whose path goes on.
    """

    L: Spectrum
    β: Spectrum
    η: Float
    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    last: ScatteringVertex
    active: Bool

    def scatters(self) -> Bool:
        """Lanes whose path has come to a surface."""
        return self.active & self.pi.is_valid()


@dataclass
class PairState:
    """Loop state.

    Attributes:
        depth: segments traced.
        current, previous: see `PathState`.
        same: lanes whose vertices are one point of a shape that stands still, or of which neither path has met anything.
    """

    depth: UInt32
    current: PathState
    previous: PathState
    same: Bool


@dataclass(frozen=True)
class Vertex:
    """What one state's path finds at a vertex.

    Attributes:
        si, bsdf: there.
        Le: emitted there, times what the path carries.
        Ld: from the point `to` of an emitter, likewise, if nothing is between.
        active: lanes from which the path may go on.
    """

    si: Any
    bsdf: Any
    Le: Spectrum
    Ld: Spectrum
    to: Any
    active: Bool


@dataclass(frozen=True)
class Direction:
    """Where one state's path may go on from a vertex.

    Attributes:
        si, bsdf: there.
        bs, weight: a sample of it.
        ray: in that direction.
        delta: lanes that sampled a perfectly specular lobe.
        active: lanes that have a vertex from which the path may go on.
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
    """Where the previous state's path does go on.

    Attributes:
        ray, pi: to the next vertex, and the primitive there.
        weight: of the direction to it, 0 where it is not to be reached.
        pdf: solid angle density with which the BSDF alone samples that direction.
        delta: lanes whose direction is perfectly specular.
        η: relative index of refraction of the step.
        same: lanes whose next vertex is that of the current state's path, see `PairState`.
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    weight: Spectrum
    pdf: Float
    delta: Bool
    η: Float
    same: Bool


class Link:
    """The vertex that a path has found in one state, its image in the other one, and the connection of that state's path to it.

    Points of meshes follow from barycentric coordinates. Where other shapes were met, which stand still, the ray tells them.

    Attributes:
        valid: lanes whose ray met something; the others' is connected to infinity.
        image: the image's primitive and the distance to it.
        direction: to the image, from the last vertex of its state.
    """

    def __init__(
        self,
        tables: Mapping[str, Any],
        out: tuple[Direction, Direction],
        hits: tuple[Any, Any],
        carried: Bool,
        active: Bool,
    ):
        (now, before), (pi, piₚ) = out, hits
        found = dr.select(carried, pi, piₚ)
        self._carried, self._triangle, self._from = carried, found.prim_index, dr.select(carried, now.ray, before.ray)
        back = remap(tables["shape_back"], piₚ.shape)
        self._shape = dr.select(carried, pi.shape, back)
        self.valid = active & found.is_valid()
        self.image = mi.PreliminaryIntersection3f(found)
        self.image.shape = dr.select(carried, remap(tables["shape"], pi.shape), back)
        self._si = found.compute_surface_interaction(self._from, mi.RayFlags.Minimal, self.valid)
        self._there: Any = self.image.compute_surface_interaction(self._from, mi.RayFlags.Minimal, self.valid)  # pyright: ignore[reportArgumentType]
        to = self._there.p - dr.select(carried, before.si.p, now.si.p)
        self._distance: Any = dr.norm(to)
        self.direction = dr.select(self.valid, to / self._distance, self._from.d)
        self.image.t = dr.select(self.valid, self._distance, found.t)

    def ray(self, vertex: Any) -> Any:
        """From the last vertex of the image's state, up to the image."""
        return dr.select(self.valid, vertex.spawn_ray_to(self._there.p), vertex.spawn_ray(self.direction))

    def density_ratio(self) -> Float:
        """Solid angle of a small area at the current state's point, seen from its path, over that at the previous state's."""
        here = dr.abs_dot(self._si.n, self._from.d) / dr.square(self._si.t)
        there = dr.abs_dot(self._there.n, self.direction) / dr.square(self._distance)
        return dr.select(self._carried, here / there, there / here)

    def area_ratio(self, tables: Mapping[str, Any]) -> Float:
        """Area of the triangle in the current over that in the previous state."""
        first = dr.gather(mi.UInt32, tables["triangles"], registry_id(self._shape))
        return dr.rcp(dr.gather(mi.Float, tables["area_ratios"], dr.select(first > 0, first + self._triangle, 0)))


def moves(tables: Mapping[str, Any], shape: Any) -> Bool:
    """Whether a shape of the current scene is one that moves."""
    return dr.gather(mi.UInt32, tables["triangles"], registry_id(shape)) > 0


def is_clear(tables: Mapping[str, Any], ray: Any, pi: Any) -> Bool:
    """Whether nothing that moves is near a ray of the current scene, up to what it meets: in the previous scene it meets the same."""
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
    """What the previous state's ray meets. Rays that equal one of the current state's meet what that has met, if nothing moves there.

    Args:
        rays: of either state.
        pi: what the current state's ray has met.
        clear: see `is_clear`.
        same: lanes in which the rays begin at one point, and `pi` is known.
        coherent: whether neighbouring rays are alike.

    Returns:
        the primitive, and lanes in which both rays meet the same point of a shape that stands still, or nothing.
    """
    ray, rayₚ = rays
    alike = same & dr.all((ray.o == rayₚ.o) & (ray.d == rayₚ.d))
    known, shape = alike & clear, remap(tables["shape"], pi.shape)
    piₚ = sceneₚ.ray_intersect_preliminary(rayₚ, coherent=coherent, active=active & ~known)
    found = mi.PreliminaryIntersection3f(pi)
    found.shape = shape
    piₚ = dr.select(known, found, piₚ)
    one = ~pi.is_valid() & ~piₚ.is_valid()
    one |= pi.is_valid() & piₚ.is_valid() & (shape == piₚ.shape) & (pi.prim_index == piₚ.prim_index)
    return piₚ, alike & one & ~moves(tables, pi.shape)


def emission(scene: Any, path: PathState, si: Any) -> Spectrum:
    """What is emitted at a vertex, times what the path carries and the weight of coming upon it by chance."""

    def emitted(at: tuple[PathState, Any]) -> Spectrum:
        path, si = at
        last = path.last
        ds = mi.DirectionSample3f(scene, si=si, ref=last.interaction)
        mis = mis_weight(last.pdf, scene.pdf_emitter_direction(last.interaction, ds, ~last.delta))
        return path.β * dr.select(last.delta, 1, mis) * ds.emitter.eval(si, path.active)

    shines: Any = path.active & (si.emitter(scene, path.active) != None)  # noqa: E711 (lane by lane)
    return dr.if_stmt(((path, si),), shines, emitted, lambda at: mi.Spectrum(0), label="emission")


def goes_on(scene: Any, pi: Any) -> Bool:
    """Lanes whose next vertex may still add something: without an environment, those that have one."""
    return mi.Bool(True) if scene.environment() is not None else pi.is_valid()


def is_diffuse(bsdf: mi.BSDFPtr) -> Bool:
    """Whether it has no lobes but diffuse ones."""
    flags = bsdf.flags()
    found = mi.has_flag(flags, mi.BSDFFlags.Diffuse)
    for kind in (mi.BSDFFlags.Delta, mi.BSDFFlags.Delta1D, mi.BSDFFlags.Glossy):
        found &= ~mi.has_flag(flags, kind)
    return found
