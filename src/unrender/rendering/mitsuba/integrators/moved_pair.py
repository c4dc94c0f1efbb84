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
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum, UInt32
from unrender.rendering.mitsuba.integrators.base import ScatteringVertex
from unrender.rendering.mitsuba.integrators.bounding_ellipsoids import BoundingEllipsoids
from unrender.rendering.mitsuba.integrators.emitters import mis_weight
from unrender.rendering.mitsuba.integrators.moved_vertices import (
    Continuation,
    Direction,
    Link,
    PairState,
    PathState,
    Vertex,
    emission,
    follow,
    goes_on,
    is_clear,
    is_diffuse,
    moves,
)
from unrender.rendering.mitsuba.integrators.pointer_tables import remap

CARRIED_SHARE = 0.75
"""Of the connections that may be carried along, the share that is: 1 would leave out what the current state's path cannot see."""


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
        clear = is_clear(tables, ray, pi)
        piₚ, same = follow(sceneₚ, tables, (ray, rayₚ), pi, clear, every, mi.Bool(self.shared), coherent=True)
        states = []
        for state, of, hit in zip(scenes, (ray, rayₚ), (pi, piₚ), strict=True):
            last, active = ScatteringVertex(dr.zeros(mi.Interaction3f), mi.Float(1), every), goes_on(state, hit)
            states.append(PathState(mi.Spectrum(0), mi.Spectrum(1), mi.Float(1), of, hit, last, active))
        path = PairState(mi.UInt32(0), states[0], states[1], same)
        if self.max_depth > 1:
            path = self._trace(scenes, tables, path, sampler, choices)

        # Where the longest paths end, and those that meet nothing, there is nothing but what is emitted.
        def end(path: PairState) -> tuple[Spectrum, Spectrum]:
            both = zip(scenes, (path.current, path.previous), self._meet(tables, path), strict=True)
            now, before = (of.L + emission(scene, of, si) for scene, of, si in both)
            return now, before

        def over(path: PairState) -> tuple[Spectrum, Spectrum]:
            return path.current.L, path.previous.L

        ends: Any = path.current.active | path.previous.active
        return dr.if_stmt((path,), ends, end, over, label="ends of moved path pair")

    @dr.syntax
    def _trace(
        self, scenes: tuple[Any, Any], tables: Mapping[str, Any], path: PairState, sampler: Any, choices: Any
    ) -> PairState:
        while dr.hint(
            (path.current.scatters() | path.previous.scatters()) & (path.depth + 1 < self.max_depth),
            label="moved path pair",
        ):
            path = self._bounce(scenes, tables, path, sampler, choices)
        return path

    def _bounce(
        self, scenes: tuple[Any, Any], tables: Mapping[str, Any], path: PairState, sampler: Any, choices: Any
    ) -> PairState:
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
        diffuse = is_diffuse(out.bsdf) & is_diffuse(outₚ.bsdf)
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
        path.current = PathState(now.L, nowβ, now.η * out.bs.eta, out.ray, pi, last, going & goes_on(scene, pi))
        last = ScatteringVertex(mi.Interaction3f(outₚ.si), way.pdf, way.delta)
        path.previous = PathState(
            before.L,
            beforeβ,
            before.η * way.η,
            way.ray,
            way.pi,
            last,
            outₚ.active & survivesₚ & goes_on(sceneₚ, way.pi),
        )
        path.same = way.same
        path.depth += 1
        return path

    def _meet(self, tables: Mapping[str, Any], path: PairState) -> tuple[Any, Any]:
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

    def _gather(self, scene: Any, path: PathState, si: Any, number: Any) -> Vertex:
        """What one state's path has come to, and a point of an emitter that it may be connected to."""
        ctx, bsdf, Le = mi.BSDFContext(), si.bsdf(), emission(scene, path, si)

        # ---------------------- Emitter sampling ----------------------
        active = path.active & si.is_valid()
        active_em = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, weight = scene.sample_emitter_direction(si, number, False, active_em)
        active_em &= ds.pdf != 0
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), active_em)
        Ld = path.β * dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf)) * value * weight
        return Vertex(si, bsdf, Le, dr.select(active_em, Ld, 0), ds.p, active)

    def _connect(
        self, scenes: tuple[Any, Any], tables: Mapping[str, Any], path: PairState, now: Vertex, before: Vertex
    ) -> None:
        """Add what emitters give, where they are to be seen. What adds nothing is not asked for, nor what is known from the other state."""
        scene, sceneₚ = scenes
        ray, asked, askedₚ = now.si.spawn_ray_to(now.to), dr.max(now.Ld) != 0, dr.max(before.Ld) != 0
        hidden = scene.ray_test(ray, asked)
        known = path.same & asked & dr.all(now.to == before.to) & ~tables["bounds"].meet(ray, ray.maxt)
        hiddenₚ = sceneₚ.ray_test(before.si.spawn_ray_to(before.to), askedₚ & ~known)
        path.current.L += now.Le + dr.select(hidden, 0, now.Ld)
        path.previous.L += before.Le + dr.select(dr.select(known, hidden, hiddenₚ), 0, before.Ld)

    def _scatter(self, vertex: Vertex, numbers: tuple[Any, Any]) -> Direction:
        """A direction off a vertex."""
        si, active = vertex.si, vertex.active
        bs, weight = vertex.bsdf.sample(mi.BSDFContext(), si, *numbers, active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        return Direction(si, vertex.bsdf, bs, weight, si.spawn_ray(si.to_world(bs.wo)), delta, active)

    def _continue(
        self,
        scenes: tuple[Any, Any],
        tables: Mapping[str, Any],
        out: tuple[Direction, Direction],
        pi: Any,
        share: Float,
        carried: Bool,
        path: PairState,
        followed: Bool,
    ) -> Continuation:
        """Where the previous state's path goes on: in its own direction, or to the current path's next vertex, as it was.

        Args:
            pi: the current path's next vertex, of the lanes `followed`.
            share, carried: probability, and which.
            path: so far.
        """
        (scene, sceneₚ), ctx, (now, before) = scenes, mi.BSDFContext(), out
        same, own = path.same, before.active & ~carried
        looked = own & self._may_add(tables, path, before.ray)
        clear = same & followed & is_clear(tables, now.ray, pi)
        piₚ, met = follow(sceneₚ, tables, (now.ray, before.ray), pi, clear, looked, same & followed)
        if not self._carries:
            bs = before.bs
            return Continuation(before.ray, piₚ, before.weight, bs.pdf, before.delta, bs.eta, met)
        asked = own & (share > 0)
        mixed = carried | asked

        link = Link(tables, (now, before), (pi, piₚ), carried, mixed)

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
        return Continuation(
            dr.select(carried, before.si.spawn_ray(link.direction), before.ray),
            dr.select(carried, link.image, piₚ),
            dr.select(mixed, weight, before.weight),
            dr.select(mixed, pdf, before.bs.pdf),
            before.delta & ~carried,
            dr.select(carried, 1, before.bs.eta),
            dr.select(carried, self.shared & ~moves(tables, pi.shape), met),
        )

    @property
    def _carries(self) -> bool:
        """Whether anything is carried along."""
        return self.max_depth > 2 and self.share > 0

    def _may_add(self, tables: Mapping[str, Any], path: PairState, ray: Any) -> Bool:
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
