"""Two states of a scene whose shapes move, on related paths.

Every connection of the previous state's path leads either to where its own random numbers lead (primary sample space), or to the point of the
current state's path, carried along with the shape that it lies on: the same triangle, the same barycentric coordinates (a shift by
reconnection, as of gradient-domain path tracing). Which of both is drawn, with a known probability, and the direction is weighted by
the density of the mixture of both (one-sample MIS with the balance heuristic). So the shift needs no inverse: where the carried
point is hidden in the previous state, it has no part in it, and where the current state's path could not have come, the density is that of the other
technique alone.

Symbols as in `path.py`; a prime (ₚ) is the previous state.
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

__all__ = ["CARRIED_SHARE", "MovedPair"]

CARRIED_SHARE = 0.75
"""Of the connections that may be carried along, the share that is: 1 would leave out what the current state's path cannot see."""


@dataclass
class _State:
    """One state's path. State of a Dr.Jit loop, hence mutable.

    Attributes:
        L: radiance gathered so far.
        β: throughput.
        η: relative index of refraction.
        si: the vertex that the path has come to.
        last: the vertex before.
        active: lanes whose path goes on.
    """

    L: Spectrum
    β: Spectrum
    η: Float
    si: mi.SurfaceInteraction3f
    last: ScatteringVertex
    active: Bool


@dataclass
class _PairState:
    """Loop state.

    Attributes:
        depth: segments traced.
        current, previous: see `_State`.
    """

    depth: UInt32
    current: _State
    previous: _State


@dataclass(frozen=True)
class _Direction:
    """Where one state's path may go on from a vertex.

    Attributes:
        bsdf: there.
        bs, weight: a sample of it.
        ray: in that direction.
        delta: lanes that sampled a perfectly specular lobe.
        active: lanes that have a vertex from which the path may go on.
    """

    bsdf: Any
    bs: mi.BSDFSample3f
    weight: Spectrum
    ray: Any
    delta: Bool
    active: Bool


@dataclass(frozen=True)
class _Continuation:
    """Where the previous state's path does go on.

    Attributes:
        si: the next vertex.
        weight: of the direction to it, 0 where it is not to be reached.
        pdf: solid angle density with which the BSDF alone samples that direction.
        delta: lanes whose direction is perfectly specular.
        η: relative index of refraction of the step.
    """

    si: mi.SurfaceInteraction3f
    weight: Spectrum
    pdf: Float
    delta: Bool
    η: Float


class MovedPair:
    """Path tracer of both states. The current state's paths are those of Mitsuba's `prb`, number for number, so that `PrbKernel` can
    replay them. Both images are unbiased.

    Args:
        max_depth: longest path in segments, >= 1.
        rr_depth: the depth from which roulette may end a path; from there on nothing is carried along.
        share: the probability of the carried connection, in [0, 1).
        areas: whether the change of a triangle's area is part of the density. Without, the previous image is biased: for tests.

    Carried are connections between vertices with diffuse lobes only: where a lobe is narrow, a direction that is a little off is another.
    The last segment is not: it can meet emitters only.
    """

    def __init__(self, max_depth: int, rr_depth: int = 5, share: float = CARRIED_SHARE, areas: bool = True):
        # No dataclass: Dr.Jit would take it for state of the loop below.
        self.max_depth, self.rr_depth, self.share, self.areas = max_depth, rr_depth, share, areas

    def sample(
        self,
        scenes: tuple[mi.Scene, mi.Scene],
        tables: Mapping[str, Any],
        sampler: Any,
        choices: Any,
        rays: tuple[Any, Any],
    ) -> tuple[Spectrum, Spectrum]:
        """Trace one path of each state per lane. Call under `dr.suspend_grad()`.

        Args:
            scenes: the current and the previous one.
            tables: "shape" and "shape_back", from registry ids of the current scene's shapes to those of the previous one's, and back;
                "triangles", of each of the current scene's shapes, where its triangles begin in "area_ratios", 0 for shapes
                that stand still; "area_ratios", area in the previous over area in the current scene, 1 at 0.
            sampler: seeded; both states use its numbers.
            choices: numbers apart, for what is carried along.
            rays: camera rays of each state.

        Returns:
            radiance per lane of the current and of the previous state.
        """
        states = []
        for scene, ray in zip(scenes, rays, strict=True):
            si = scene.ray_intersect(mi.Ray3f(ray), ray_flags=mi.RayFlags.All, coherent=True, active=mi.Bool(True))
            last = ScatteringVertex(dr.zeros(mi.SurfaceInteraction3f), mi.Float(1), mi.Bool(True))
            states.append(_State(mi.Spectrum(0), mi.Spectrum(1), mi.Float(1), si, last, mi.Bool(True)))
        path = self._trace(scenes, tables, _PairState(mi.UInt32(0), *states), sampler, choices)
        return path.current.L, path.previous.L

    @dr.syntax
    def _trace(
        self, scenes: tuple[mi.Scene, mi.Scene], tables: Mapping[str, Any], path: _PairState, sampler: Any, choices: Any
    ) -> _PairState:
        while dr.hint(
            path.current.active | path.previous.active, max_iterations=self.max_depth, label="moved path pair"
        ):
            path = self._bounce(scenes, tables, path, sampler, choices)
        return path

    def _bounce(
        self, scenes: tuple[mi.Scene, mi.Scene], tables: Mapping[str, Any], path: _PairState, sampler: Any, choices: Any
    ) -> _PairState:
        """The vertices that both paths have come to, and where they go on from there."""
        scene, sceneₚ = scenes
        now, before = path.current, path.previous
        numbers = sampler.next_2d(), sampler.next_1d(), sampler.next_2d()
        deeper = path.depth + 1 < self.max_depth
        out, outₚ = (self._scatter(s, of, numbers, deeper) for s, of in ((scene, now), (sceneₚ, before)))

        # ------------------ Which connections are carried ------------------
        diffuse = _is_diffuse(out.bsdf) & _is_diffuse(outₚ.bsdf)
        able = out.active & outₚ.active & diffuse & (path.depth < self.rr_depth) & (path.depth + 2 < self.max_depth)
        share = dr.select(able, mi.Float(self.share), 0)
        carried = choices.next_1d() < share

        # -------------------- Roulette, as in `prb` --------------------
        number = sampler.next_1d()
        nowβ = now.β * out.weight
        survives, nowβ = self._roulette(path.depth, nowβ, now.η * out.bs.eta, number)
        going = out.active & survives

        # ----------------- The current path's next vertex -----------------
        # Where it has ended, it may still tell the other where to go.
        hit = _Hit(scene, out.ray, going | (carried & (out.bs.pdf > 0)))

        # ----------------- The previous path's next vertex -----------------
        way = self._continue(scenes, tables, path, (out, outₚ), hit, share, carried)
        beforeβ = before.β * way.weight
        survivesₚ, beforeβ = self._roulette(path.depth, beforeβ, before.η * way.η, number)

        path.current = _State(
            now.L, nowβ, now.η * out.bs.eta, hit.si, ScatteringVertex(now.si, out.bs.pdf, out.delta), going
        )
        last = ScatteringVertex(before.si, way.pdf, way.delta)
        path.previous = _State(before.L, beforeβ, before.η * way.η, way.si, last, outₚ.active & survivesₚ)
        path.depth += 1
        return path

    def _scatter(self, scene: Any, path: _State, numbers: tuple[Any, Any, Any], deeper: Bool) -> _Direction:
        """What one state gathers at its vertex, and a direction off it."""
        ctx, si, last = mi.BSDFContext(), path.si, path.last
        number, number_lobe, number_bsdf = numbers
        bsdf = si.bsdf()

        # ---------------------- Direct emission ----------------------
        ds = mi.DirectionSample3f(scene, si=si, ref=last.interaction)
        mis = mis_weight(last.pdf, scene.pdf_emitter_direction(last.interaction, ds, ~last.delta))
        Le = path.β * dr.select(last.delta, 1, mis) * ds.emitter.eval(si, path.active)

        # ---------------------- Emitter sampling ----------------------
        active = path.active & deeper & si.is_valid()
        active_em = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, weight = scene.sample_emitter_direction(si, number, True, active_em)
        active_em &= ds.pdf != 0
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), active_em)
        Ld = path.β * dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf)) * value * weight
        path.L += dr.select(path.active, Le, 0) + dr.select(active_em, Ld, 0)

        # ---------------------- BSDF sampling ----------------------
        bs, weight = bsdf.sample(ctx, si, number_lobe, number_bsdf, active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        return _Direction(bsdf, bs, weight, si.spawn_ray(si.to_world(bs.wo)), delta, active)

    def _continue(
        self,
        scenes: tuple[Any, Any],
        tables: Mapping[str, Any],
        path: _PairState,
        out: tuple[_Direction, _Direction],
        hit: _Hit,
        share: Float,
        carried: Bool,
    ) -> _Continuation:
        """Where the previous state's path goes on: in its own direction, or to the current path's next vertex, `hit`, as it was."""
        (scene, sceneₚ), ctx, (now, before) = scenes, mi.BSDFContext(), out
        at, atₚ = path.current.si, path.previous.si
        own = before.active & ~carried
        asked = own & (share > 0)

        # ------------ The next vertex by either, and in the other state ------------
        hitₚ = _Hit(sceneₚ, before.ray, own)
        there = hit.carried(remap(tables["shape"], hit.pi.shape), carried)
        back = hitₚ.carried(shape := remap(tables["shape_back"], hitₚ.pi.shape), asked)
        link, link_back = _Link(atₚ, there, hit), _Link(at, back, hitₚ)

        # ---------------- Densities of both, over solid angle ----------------
        wo = dr.select(carried, now.bs.wo, at.to_local(link_back.direction))
        woₚ = dr.select(carried, atₚ.to_local(link.direction), before.bs.wo)
        forward = now.bsdf.pdf(ctx, at, wo, carried | asked)
        value, pdf = before.bsdf.eval_pdf(ctx, atₚ, woₚ, carried | asked)
        free = carried & (forward > 0) & (dr.max(value) > 0)
        free &= ~sceneₚ.ray_test(link.ray, free)
        seen = asked & (forward > 0)
        seen &= ~scene.ray_test(link_back.ray, seen)
        ratio = self._area_ratio(
            tables,
            dr.select(carried, hit.pi.shape, shape),
            dr.select(carried, hit.pi.prim_index, hitₚ.pi.prim_index),
        )
        near = dr.select(carried, hit.per_area, link_back.per_area)
        nearₚ = dr.select(carried, link.per_area, hitₚ.per_area)
        finite = dr.select(carried, hit.valid, hitₚ.valid)
        forward = dr.select(carried | seen, forward * dr.select(finite, near / (ratio * nearₚ), 1), 0)

        # ------------------------------ Mixture ------------------------------
        weight = value / (share * forward + (1 - share) * pdf)
        weight = dr.select(carried & ~free | ~dr.isfinite(dr.sum(weight)), 0, weight)
        mixed = carried | asked
        there.wi, there.t = there.to_local(-link.direction), link.distance
        return _Continuation(
            dr.select(carried, dr.select(hit.valid, there, hit.si), hitₚ.si),
            dr.select(mixed, weight, before.weight),
            dr.select(mixed, pdf, before.bs.pdf),
            before.delta & ~carried,
            dr.select(carried, 1, before.bs.eta),
        )

    def _area_ratio(self, tables: Mapping[str, Any], shape: Any, triangle: UInt32) -> Float:
        """Area of a triangle in the previous over that in the current state; `shape` is the current scene's."""
        if not self.areas:
            return mi.Float(1)
        first = dr.gather(mi.UInt32, tables["triangles"], registry_id(shape))
        return dr.gather(mi.Float, tables["area_ratios"], dr.select(first > 0, first + triangle, 0))

    def _roulette(self, depth: UInt32, β: Spectrum, η: Float, number: Float) -> tuple[Bool, Spectrum]:
        """Which lanes go on, and their throughput."""
        most = dr.max(β)
        q = dr.minimum(most * dr.square(η), 0.95)
        asked = depth >= self.rr_depth
        return (most != 0) & (~asked | (number < q)), β * dr.select(asked, dr.rcp(q), 1)


class _Hit:
    """What a ray meets.

    Attributes:
        ray: itself.
        pi: the primitive.
        si: the vertex; of rays that meet nothing, the way out.
        valid: lanes that meet something.
        per_area: solid angle per area there.
    """

    def __init__(self, scene: Any, ray: Any, active: Bool):
        self.ray = ray
        self.pi: Any = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        self.si: Any = self.pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        self.valid = active & self.pi.is_valid()
        self.per_area = _per_area(self.si, ray.d, self.si.t)

    def carried(self, shape: Any, active: Bool) -> Any:
        """The vertex on another scene's shape, at the same primitive and barycentric coordinates.

        Points of meshes follow from these; where other shapes, which stand still, were met, the ray tells it.
        """
        pi = mi.PreliminaryIntersection3f(self.pi)
        pi.shape = shape
        return pi.compute_surface_interaction(self.ray, mi.RayFlags.All, active & self.valid)


class _Link:
    """A connection from a vertex to a carried point or, where the ray met nothing, in the ray's direction.

    Attributes:
        direction: normalized.
        distance: inf where the ray met nothing.
        per_area: solid angle at the vertex per area at the point.
        ray: to test whether it is free.
    """

    def __init__(self, vertex: mi.SurfaceInteraction3f, point: Any, hit: _Hit):
        to = point.p - vertex.p
        distance = dr.norm(to)
        self.direction = dr.select(hit.valid, to / distance, hit.ray.d)
        self.distance = dr.select(hit.valid, distance, dr.inf)
        self.per_area = _per_area(point, self.direction, distance)
        self.ray = dr.select(hit.valid, vertex.spawn_ray_to(point.p), vertex.spawn_ray(hit.ray.d))


def _per_area(si: Any, direction: Any, distance: Float) -> Float:
    """Solid angle per area of what is met at `si`."""
    return dr.abs_dot(si.n, direction) / dr.square(distance)


def _is_diffuse(bsdf: mi.BSDFPtr) -> Bool:
    """Whether it has no lobes but diffuse ones."""
    flags = bsdf.flags()
    found = mi.has_flag(flags, mi.BSDFFlags.Diffuse)
    for kind in (mi.BSDFFlags.Delta, mi.BSDFFlags.Delta1D, mi.BSDFFlags.Glossy):
        found &= ~mi.has_flag(flags, kind)
    return found
