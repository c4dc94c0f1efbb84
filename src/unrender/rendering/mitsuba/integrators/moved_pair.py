"""Two states of a scene whose shapes move, on related paths.

Every connection of the previous state's path leads either to where its own random numbers lead (primary sample space), or to the
point of the current state's path, carried along with the shape that it lies on: the same triangle, the same barycentric coordinates
(a shift by reconnection, as in gradient-domain path tracing). Which of both is drawn, with a known probability, and the direction is
weighted by the density of the mixture of both (one-sample MIS with the balance heuristic). So the shift needs no inverse: a carried
point that is hidden in the previous state has no part in it, and where the current state's path could not have come, the density is
that of the other technique alone.

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
from unrender.rendering.mitsuba.integrators.bounding_ellipsoids import BoundingEllipsoids
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
class _PairState:
    """Loop state.

    Attributes:
        depth: segments traced.
        current, previous: see `_State`.
        same: lanes whose vertices are one point of a shape that stands still, or of which neither path has met anything.
    """

    depth: UInt32
    current: _State
    previous: _State
    same: Bool


@dataclass(frozen=True)
class _Vertex:
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
class _Direction:
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
class _Continuation:
    """Where the previous state's path does go on.

    Attributes:
        ray, pi: to the next vertex, and the primitive there.
        weight: of the direction to it, 0 where it is not to be reached.
        pdf: solid angle density with which the BSDF alone samples that direction.
        delta: lanes whose direction is perfectly specular.
        η: relative index of refraction of the step.
        same: lanes whose next vertex is that of the current state's path, see `_PairState`.
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    weight: Spectrum
    pdf: Float
    delta: Bool
    η: Float
    same: Bool


class MovedPair:
    """Path tracer of both states. The current state's paths are those of Mitsuba's `prb`, number for number, so that `PrbKernel` can
    replay them. Both images are unbiased.

    Args:
        max_depth: longest path in segments, >= 1.
        rr_depth: the depth from which roulette may end a path; from there on nothing is carried along.
        share: the probability of the carried connection, in [0, 1).
        areas: whether the change of a triangle's area is part of the density. Without, the previous image is biased: for tests.
        shared: whether rays that are the same in both states, and near nothing that moves, are traced for the current one alone. Not
            where anything but meshes and sensors moves, which the bounds do not know.

    Carried are connections between vertices with diffuse lobes only: where a lobe is narrow, a direction that is a little off is another.
    The last segment is not: it can meet emitters only.
    """

    def __init__(
        self, max_depth: int, rr_depth: int = 5, share: float = CARRIED_SHARE, areas: bool = True, shared: bool = True
    ):
        # No dataclass: Dr.Jit would take it for state of the loop below.
        self.max_depth, self.rr_depth, self.share, self.areas, self.shared = max_depth, rr_depth, share, areas, shared

    def sample(
        self,
        scenes: tuple[Any, Any],
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
                that stand still; "area_ratios", area in the previous over area in the current scene, 1 at 0; "ellipsoids", see
                `BoundingEllipsoids`, about what moves in either state; "emitters", likewise about all that emits, or None
                where that is everywhere or not known.
            sampler: seeded; both states use its numbers.
            choices: numbers apart, for what is carried along.
            rays: camera rays of each state.

        Returns:
            radiance per lane of the current and of the previous state.
        """
        (scene, sceneₚ), (ray, rayₚ) = scenes, (mi.Ray3f(of) for of in rays)
        lights = None if tables["emitters"] is None else BoundingEllipsoids(tables["emitters"])
        tables = {**tables, "bounds": BoundingEllipsoids(tables["ellipsoids"]), "lights": lights}
        every = mi.Bool(True)
        pi = scene.ray_intersect_preliminary(ray, coherent=True, active=every)
        clear = _is_clear(tables, ray, pi)
        piₚ, same = _follow(sceneₚ, tables, (ray, rayₚ), pi, clear, every, mi.Bool(self.shared), coherent=True)
        states = []
        for state, of, hit in zip(scenes, (ray, rayₚ), (pi, piₚ), strict=True):
            last, active = ScatteringVertex(dr.zeros(mi.Interaction3f), mi.Float(1), every), _goes_on(state, hit)
            states.append(_State(mi.Spectrum(0), mi.Spectrum(1), mi.Float(1), of, hit, last, active))
        path = _PairState(mi.UInt32(0), states[0], states[1], same)
        if self.max_depth > 1:
            path = self._trace(scenes, tables, path, sampler, choices)

        # Where the longest paths end, and those that meet nothing, there is nothing but what is emitted.
        def end(path: _PairState) -> tuple[Spectrum, Spectrum]:
            both = zip(scenes, (path.current, path.previous), self._meet(tables, path), strict=True)
            now, before = (of.L + _emission(scene, of, si) for scene, of, si in both)
            return now, before

        def over(path: _PairState) -> tuple[Spectrum, Spectrum]:
            return path.current.L, path.previous.L

        ends: Any = path.current.active | path.previous.active
        return dr.if_stmt((path,), ends, end, over, label="ends of moved path pair")

    @dr.syntax
    def _trace(
        self, scenes: tuple[Any, Any], tables: Mapping[str, Any], path: _PairState, sampler: Any, choices: Any
    ) -> _PairState:
        while dr.hint(
            (path.current.scatters() | path.previous.scatters()) & (path.depth + 1 < self.max_depth),
            label="moved path pair",
        ):
            path = self._bounce(scenes, tables, path, sampler, choices)
        return path

    def _bounce(
        self, scenes: tuple[Any, Any], tables: Mapping[str, Any], path: _PairState, sampler: Any, choices: Any
    ) -> _PairState:
        """The vertices that both paths have come to, and where they go on from there."""
        scene, sceneₚ = scenes
        now, before = path.current, path.previous
        numbers = sampler.next_2d(), sampler.next_1d(), sampler.next_2d()
        si, siₚ = self._meet(tables, path)
        near = self._gather(scene, now, si, numbers[0])
        nearₚ = self._gather(sceneₚ, before, siₚ, numbers[0])
        self._connect(scenes, tables, path, near, nearₚ)
        out, outₚ = (self._scatter(of, numbers[1:]) for of in (near, nearₚ))

        # ------------------ Which connections are carried ------------------
        diffuse = _is_diffuse(out.bsdf) & _is_diffuse(outₚ.bsdf)
        able = out.active & outₚ.active & diffuse & (path.depth < self.rr_depth) & (path.depth + 2 < self.max_depth)
        share = dr.select(able, mi.Float(self.share), 0)
        carried = choices.next_1d() < share if self._carries else mi.Bool(False)

        # -------------------- Roulette, as in `prb` --------------------
        number = sampler.next_1d()
        nowβ = now.β * out.weight
        survives, nowβ = self._roulette(path.depth, nowβ, now.η * out.bs.eta, number)
        going = out.active & survives

        # ----------------- The current path's next vertex -----------------
        # Where it has ended, it may still tell the other where to go.
        following = going | (carried & (out.bs.pdf > 0))
        pi = scene.ray_intersect_preliminary(
            out.ray, coherent=False, active=following & self._may_add(tables, path, out.ray)
        )

        # ----------------- The previous path's next vertex -----------------
        way = self._continue(scenes, tables, (out, outₚ), pi, share, carried, path, following)
        beforeβ = before.β * way.weight
        survivesₚ, beforeβ = self._roulette(path.depth, beforeβ, before.η * way.η, number)

        last = ScatteringVertex(mi.Interaction3f(out.si), out.bs.pdf, out.delta)
        path.current = _State(now.L, nowβ, now.η * out.bs.eta, out.ray, pi, last, going & _goes_on(scene, pi))
        last = ScatteringVertex(mi.Interaction3f(outₚ.si), way.pdf, way.delta)
        path.previous = _State(
            before.L,
            beforeβ,
            before.η * way.η,
            way.ray,
            way.pi,
            last,
            outₚ.active & survivesₚ & _goes_on(sceneₚ, way.pi),
        )
        path.same = way.same
        path.depth += 1
        return path

    def _meet(self, tables: Mapping[str, Any], path: _PairState) -> tuple[Any, Any]:
        """The vertices that both paths have come to. Where they are one, the previous state's is the current one's, seen from where its
        path comes from."""
        now, before = path.current, path.previous
        alone = before.active & ~path.same
        here = now.active | (before.active & path.same)
        si: Any = now.pi.compute_surface_interaction(now.ray, mi.RayFlags.All, here)  # pyright: ignore[reportArgumentType]
        own: Any = before.pi.compute_surface_interaction(before.ray, mi.RayFlags.All, alone)  # pyright: ignore[reportArgumentType]
        one = mi.SurfaceInteraction3f(si)
        one.shape = remap(tables["shape"], si.shape)
        one.wi = dr.select(si.is_valid(), si.to_local(-before.ray.d), -before.ray.d)
        return si, dr.select(path.same, one, own)

    def _gather(self, scene: Any, path: _State, si: Any, number: Any) -> _Vertex:
        """What one state's path has come to, and a point of an emitter that it may be connected to."""
        ctx, bsdf, Le = mi.BSDFContext(), si.bsdf(), _emission(scene, path, si)

        # ---------------------- Emitter sampling ----------------------
        active = path.active & si.is_valid()
        active_em = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, weight = scene.sample_emitter_direction(si, number, False, active_em)
        active_em &= ds.pdf != 0
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), active_em)
        Ld = path.β * dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf)) * value * weight
        return _Vertex(si, bsdf, Le, dr.select(active_em, Ld, 0), ds.p, active)

    def _connect(
        self, scenes: tuple[Any, Any], tables: Mapping[str, Any], path: _PairState, now: _Vertex, before: _Vertex
    ) -> None:
        """Add what emitters give, where they are to be seen. What adds nothing is not asked for, nor what is known from the other state."""
        scene, sceneₚ = scenes
        ray, asked, askedₚ = now.si.spawn_ray_to(now.to), dr.max(now.Ld) != 0, dr.max(before.Ld) != 0
        hidden = scene.ray_test(ray, asked)
        known = path.same & asked & dr.all(now.to == before.to) & ~tables["bounds"].meet(ray, ray.maxt)
        hiddenₚ = sceneₚ.ray_test(before.si.spawn_ray_to(before.to), askedₚ & ~known)
        path.current.L += now.Le + dr.select(hidden, 0, now.Ld)
        path.previous.L += before.Le + dr.select(dr.select(known, hidden, hiddenₚ), 0, before.Ld)

    def _scatter(self, vertex: _Vertex, numbers: tuple[Any, Any]) -> _Direction:
        """A direction off a vertex."""
        si, active = vertex.si, vertex.active
        bs, weight = vertex.bsdf.sample(mi.BSDFContext(), si, *numbers, active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        return _Direction(si, vertex.bsdf, bs, weight, si.spawn_ray(si.to_world(bs.wo)), delta, active)

    def _continue(
        self,
        scenes: tuple[Any, Any],
        tables: Mapping[str, Any],
        out: tuple[_Direction, _Direction],
        pi: Any,
        share: Float,
        carried: Bool,
        path: _PairState,
        followed: Bool,
    ) -> _Continuation:
        """Where the previous state's path goes on: in its own direction, or to the current path's next vertex, as it was.

        Args:
            pi: the current path's next vertex, of the lanes `followed`.
            share, carried: probability, and which.
            path: so far.
        """
        (scene, sceneₚ), ctx, (now, before) = scenes, mi.BSDFContext(), out
        same, own = path.same, before.active & ~carried
        looked = own & self._may_add(tables, path, before.ray)
        clear = same & followed & _is_clear(tables, now.ray, pi)
        piₚ, met = _follow(sceneₚ, tables, (now.ray, before.ray), pi, clear, looked, same & followed)
        if not self._carries:
            bs = before.bs
            return _Continuation(before.ray, piₚ, before.weight, bs.pdf, before.delta, bs.eta, met)
        asked = own & (share > 0)
        mixed = carried | asked

        link = _Link(tables, (now, before), (pi, piₚ), carried, mixed)

        # ------------- Whether either technique could have come there -------------
        wo = dr.select(carried, now.bs.wo, now.si.to_local(link.direction))
        woₚ = dr.select(carried, before.si.to_local(link.direction), before.bs.wo)
        forward = now.bsdf.pdf(ctx, now.si, wo, mixed)
        value, pdf = before.bsdf.eval_pdf(ctx, before.si, woₚ, mixed)
        free = carried & (forward > 0) & (dr.max(value) > 0)
        free &= clear | ~sceneₚ.ray_test(link.ray(before.si), free & ~clear)
        seen = asked & (forward > 0)
        seen &= met | ~scene.ray_test(link.ray(now.si), seen & ~met)
        change = link.density_ratio() * (link.area_ratio(tables) if self.areas else 1)
        forward = dr.select(carried | seen, forward * dr.select(link.valid, change, 1), 0)

        # ------------------------------ Mixture ------------------------------
        weight = value / (share * forward + (1 - share) * pdf)
        weight = dr.select((carried & ~free) | ~dr.isfinite(dr.sum(weight)), 0, weight)
        return _Continuation(
            dr.select(carried, before.si.spawn_ray(link.direction), before.ray),
            dr.select(carried, link.image, piₚ),
            dr.select(mixed, weight, before.weight),
            dr.select(mixed, pdf, before.bs.pdf),
            before.delta & ~carried,
            dr.select(carried, 1, before.bs.eta),
            dr.select(carried, self.shared & ~_moves(tables, pi.shape), met),
        )

    @property
    def _carries(self) -> bool:
        """Whether anything is carried along."""
        return self.max_depth > 2 and self.share > 0

    def _may_add(self, tables: Mapping[str, Any], path: _PairState, ray: Any) -> Bool:
        """Lanes whose next segment may add something: the last one must meet an emitter."""
        if tables["lights"] is None:
            return mi.Bool(True)
        return (path.depth + 2 < self.max_depth) | tables["lights"].meet(ray, mi.Float(dr.inf))

    def _roulette(self, depth: UInt32, β: Spectrum, η: Float, number: Float) -> tuple[Bool, Spectrum]:
        """Which lanes go on, and their throughput."""
        most = dr.max(β)
        q = dr.minimum(most * dr.square(η), 0.95)
        asked = depth >= self.rr_depth
        return (most != 0) & (~asked | (number < q)), β * dr.select(asked, dr.rcp(q), 1)


class _Link:
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
        out: tuple[_Direction, _Direction],
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


def _moves(tables: Mapping[str, Any], shape: Any) -> Bool:
    """Whether a shape of the current scene is one that moves."""
    return dr.gather(mi.UInt32, tables["triangles"], registry_id(shape)) > 0


def _is_clear(tables: Mapping[str, Any], ray: Any, pi: Any) -> Bool:
    """Whether nothing that moves is near a ray of the current scene, up to what it meets: in the previous scene it meets the same."""
    return ~_moves(tables, pi.shape) & ~tables["bounds"].meet(ray, pi.t)


def _follow(
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
        clear: see `_is_clear`.
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
    return piₚ, alike & one & ~_moves(tables, pi.shape)


def _emission(scene: Any, path: _State, si: Any) -> Spectrum:
    """What is emitted at a vertex, times what the path carries and the weight of coming upon it by chance."""

    def emitted(at: tuple[_State, Any]) -> Spectrum:
        path, si = at
        last = path.last
        ds = mi.DirectionSample3f(scene, si=si, ref=last.interaction)
        mis = mis_weight(last.pdf, scene.pdf_emitter_direction(last.interaction, ds, ~last.delta))
        return path.β * dr.select(last.delta, 1, mis) * ds.emitter.eval(si, path.active)

    shines: Any = path.active & (si.emitter(scene, path.active) != None)  # noqa: E711 (lane by lane)
    return dr.if_stmt(((path, si),), shines, emitted, lambda at: mi.Spectrum(0), label="emission")


def _goes_on(scene: Any, pi: Any) -> Bool:
    """Lanes whose next vertex may still add something: without an environment, those that have one."""
    return mi.Bool(True) if scene.environment() is not None else pi.is_valid()


def _is_diffuse(bsdf: mi.BSDFPtr) -> Bool:
    """Whether it has no lobes but diffuse ones."""
    flags = bsdf.flags()
    found = mi.has_flag(flags, mi.BSDFFlags.Diffuse)
    for kind in (mi.BSDFFlags.Delta, mi.BSDFFlags.Delta1D, mi.BSDFFlags.Glossy):
        found &= ~mi.has_flag(flags, kind)
    return found
