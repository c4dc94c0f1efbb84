"""Paths of two states of a scene with moving shapes, related by reconnection shifts.

Each segment of the previous state's path leads to one of two points. One is the point that its own random numbers give (primary sample
space). The other is the point of the current state's path, moved with its shape: same triangle, same barycentric coordinates (a
reconnection shift, as in gradient-domain path tracing). The choice has a known probability, and the direction is weighted by the
density of the mixture (one-sample MIS with the balance heuristic). The shift therefore needs no inverse: a moved point that is occluded
in the previous state contributes 0, and where the current state's path cannot arrive, only the density of the other technique counts.

Symbols as in `path.py`; a subscript (ₚ) is the previous state.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.base import (
    Bool,
    Float,
    ScatteringVertex,
    Spectrum,
    UInt32,
    remap,
    while_loop,
)
from unrender.rendering.mitsuba.integrators.emitters import mis_weight
from unrender.rendering.mitsuba.integrators.moved_vertices import (
    BoundingEllipsoids,
    Continuation,
    Direction,
    Link,
    PairState,
    PathState,
    Vertex,
    emission,
    follow,
    is_clear,
    is_diffuse,
    may_contribute,
    moves,
)

CARRIED_SHARE = 0.75
"""Probability of a reconnection where it is possible. With 1, points that the current state's path cannot see would be missing."""


class MovedPair:
    """Path tracer of both states. The current state's paths use the random numbers of Mitsuba's `prb`, so `PrbKernel` can replay them.
    Both images are unbiased.

    Args:
        max_depth: maximum path length in segments, >= 1.
        rr_depth: depth from which Russian roulette may terminate a path; no reconnections from there on.
        share: probability of a reconnection, in [0, 1).
        areas: whether the density includes the change of a triangle's area. Without it, the previous image is biased: for tests.
        shared: whether rays that are equal in both states, and far from moving shapes, are traced for the current state only. Set it to
            False if anything but meshes and sensors moves, since the bounds only contain meshes.

    Reconnections join vertices with diffuse lobes only, since a narrow lobe is sensitive to small changes of direction. The last
    segment is not reconnected, since only emission contributes there.
    """

    def __init__(
        self, max_depth: int, rr_depth: int = 5, share: float = CARRIED_SHARE, areas: bool = True, shared: bool = True
    ):
        # This is not a dataclass, since Dr.Jit would treat a dataclass as state of the loop below.
        self.max_depth, self.rr_depth, self.share, self.areas, self.shared = max_depth, rr_depth, share, areas, shared

    def sample(
        self, scenes: tuple[Any, Any], tables: Mapping[str, Any], sampler: Any, choices: Any, rays: tuple[Any, Any]
    ) -> tuple[Spectrum, Spectrum]:
        """Trace one path of each state per lane. Call under `dr.suspend_grad()`.

        Args:
            scenes: the current and the previous scene.
            tables: "shape" and "shape_back", maps between registry ids of the current and the previous scene's shapes; "triangles", for
                each of the current scene's shapes the index of its first triangle in "area_ratios", 0 for static shapes; "area_ratios",
                area in the previous over area in the current scene, 1 at index 0; "ellipsoids", see `BoundingEllipsoids`, around everything
                that moves in either state; "emitters", ellipsoids around all emitters, or None if they are unbounded or unknown.
            sampler: seeded; both states use its numbers.
            choices: independent random numbers, which choose the reconnections.
            rays: camera rays of each state.

        Returns:
            radiance per lane of the current and of the previous state.
        """
        (scene, sceneₚ), (ray, rayₚ) = scenes, (mi.Ray3f(camera_ray) for camera_ray in rays)
        lights = None if tables["emitters"] is None else BoundingEllipsoids(tables["emitters"])
        tables = {**tables, "bounds": BoundingEllipsoids(tables["ellipsoids"]), "lights": lights}
        every = mi.Bool(True)
        pi = scene.ray_intersect_preliminary(ray, coherent=True, active=every)
        clear = is_clear(tables, ray, pi)
        piₚ, same = follow(sceneₚ, tables, (ray, rayₚ), pi, clear, every, mi.Bool(self.shared), coherent=True)
        states = []
        for state, camera_ray, hit in zip(scenes, (ray, rayₚ), (pi, piₚ), strict=True):
            last, active = ScatteringVertex(dr.zeros(mi.Interaction3f), mi.Float(1), every), may_contribute(state, hit)
            states.append(PathState(mi.Spectrum(0), mi.Spectrum(1), mi.Float(1), camera_ray, hit, last, active))
        path = PairState(mi.UInt32(0), states[0], states[1], same)
        if self.max_depth > 1:
            path, *_ = while_loop(
                (path, sampler, choices),
                lambda path, sampler, choices: (
                    (path.current.scatters() | path.previous.scatters()) & (path.depth + 1 < self.max_depth)
                ),
                functools.partial(self._bounce, scenes, tables),
                label="moved path pair",
            )

        # Only emission contributes where paths of maximum length end, and where paths leave the scene.
        def end(path: PairState) -> tuple[Spectrum, Spectrum]:
            both = zip(scenes, (path.current, path.previous), self._meet(tables, path), strict=True)
            now, before = (camera_ray.L + emission(scene, camera_ray, si) for scene, camera_ray, si in both)
            return now, before

        def over(path: PairState) -> tuple[Spectrum, Spectrum]:
            return path.current.L, path.previous.L

        ends: Any = path.current.active | path.previous.active
        return dr.if_stmt((path,), ends, end, over, label="ends of moved path pair")

    def _bounce(
        self, scenes: tuple[Any, Any], tables: Mapping[str, Any], path: PairState, sampler: Any, choices: Any
    ) -> tuple[PairState, Any, Any]:
        """Process the current vertices of both paths, and sample their next segments."""
        scene, sceneₚ = scenes
        now, before = path.current, path.previous
        numbers = sampler.next_2d(), sampler.next_1d(), sampler.next_2d()
        si, siₚ = self._meet(tables, path)
        near = self._gather(scene, now, si, numbers[0])
        nearₚ = self._gather(sceneₚ, before, siₚ, numbers[0])
        self._connect(scenes, tables, path, near, nearₚ)
        out, outₚ = (self._scatter(of, numbers[1:]) for of in (near, nearₚ))

        # ----------------------- Choice of reconnections -----------------------
        diffuse = is_diffuse(out.bsdf) & is_diffuse(outₚ.bsdf)
        able = out.active & outₚ.active & diffuse & (path.depth < self.rr_depth) & (path.depth + 2 < self.max_depth)
        share = dr.select(able, mi.Float(self.share), 0)
        reconnected = choices.next_1d() < share if self._reconnects else mi.Bool(False)

        # -------------------- Roulette, as in `prb` --------------------
        number = sampler.next_1d()
        nowβ = now.β * out.weight
        survives, nowβ = self._roulette(path.depth, nowβ, now.η * out.bs.eta, number)
        continues = out.active & survives

        # ----------------- The current path's next vertex -----------------
        # A terminated path may still give the point of a reconnection.
        following = continues | (reconnected & (out.bs.pdf > 0))
        pi = scene.ray_intersect_preliminary(
            out.ray, coherent=False, active=following & self._may_add(tables, path, out.ray)
        )

        # ----------------- The previous path's next vertex -----------------
        step = self._continue(scenes, tables, (out, outₚ), pi, share, reconnected, path, following)
        beforeβ = before.β * step.weight
        survivesₚ, beforeβ = self._roulette(path.depth, beforeβ, before.η * step.η, number)

        last = ScatteringVertex(mi.Interaction3f(out.si), out.bs.pdf, out.delta)
        path.current = PathState(
            now.L, nowβ, now.η * out.bs.eta, out.ray, pi, last, continues & may_contribute(scene, pi)
        )
        last = ScatteringVertex(mi.Interaction3f(outₚ.si), step.pdf, step.delta)
        path.previous = PathState(
            before.L,
            beforeβ,
            before.η * step.η,
            step.ray,
            step.pi,
            last,
            outₚ.active & survivesₚ & may_contribute(sceneₚ, step.pi),
        )
        path.same = step.same
        path.depth += 1
        return path, sampler, choices

    def _meet(self, tables: Mapping[str, Any], path: PairState) -> tuple[Any, Any]:
        """Return the current vertices of both paths. If they coincide, the previous state's is a copy with its own incident direction."""
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
        """Return a vertex of one state's path: its emission, and a point on an emitter for next-event estimation."""
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
        """Add the contributions of visible emitter samples. Shadow rays are skipped for contributions of 0 and for results of the other
        state."""
        scene, sceneₚ = scenes
        ray, contributes, contributesₚ = now.si.spawn_ray_to(now.to), dr.max(now.Ld) != 0, dr.max(before.Ld) != 0
        hidden = scene.ray_test(ray, contributes)
        known = path.same & contributes & dr.all(now.to == before.to) & ~tables["bounds"].meet(ray, ray.maxt)
        hiddenₚ = sceneₚ.ray_test(before.si.spawn_ray_to(before.to), contributesₚ & ~known)
        path.current.L += now.Le + dr.select(hidden, 0, now.Ld)
        path.previous.L += before.Le + dr.select(dr.select(known, hidden, hiddenₚ), 0, before.Ld)

    def _scatter(self, vertex: Vertex, numbers: tuple[Any, Any]) -> Direction:
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
        reconnected: Bool,
        path: PairState,
        followed: Bool,
    ) -> Continuation:
        """Return the next segment of the previous state's path: in its own direction, or a reconnection to the current path's next vertex
        (`pi`).

        `share` is the probability of a reconnection, and `followed` the lanes whose current path has a next vertex.
        """
        (scene, sceneₚ), ctx, (now, before) = scenes, mi.BSDFContext(), out
        same, own = path.same, before.active & ~reconnected
        traced = own & self._may_add(tables, path, before.ray)
        clear = same & followed & is_clear(tables, now.ray, pi)
        piₚ, coincides = follow(sceneₚ, tables, (now.ray, before.ray), pi, clear, traced, same & followed)
        if not self._reconnects:
            bs = before.bs
            return Continuation(before.ray, piₚ, before.weight, bs.pdf, before.delta, bs.eta, coincides)
        weighed = own & (share > 0)
        mixed = reconnected | weighed

        link = Link(tables, (now, before), (pi, piₚ), reconnected, mixed)

        # ------------- Densities of both techniques at the chosen point -------------
        wo = dr.select(reconnected, now.bs.wo, now.si.to_local(link.direction))
        woₚ = dr.select(reconnected, before.si.to_local(link.direction), before.bs.wo)
        forward = now.bsdf.pdf(ctx, now.si, wo, mixed)
        value, pdf = before.bsdf.eval_pdf(ctx, before.si, woₚ, mixed)
        free = reconnected & (forward > 0) & (dr.max(value) > 0)
        free &= clear | ~sceneₚ.ray_test(link.ray(before.si), free & ~clear)
        visible = weighed & (forward > 0)
        visible &= coincides | ~scene.ray_test(link.ray(now.si), visible & ~coincides)
        change = link.density_ratio() * (link.area_ratio(tables) if self.areas else 1)
        forward = dr.select(reconnected | visible, forward * dr.select(link.valid, change, 1), 0)

        # ------------------------------ Mixture ------------------------------
        weight = value / (share * forward + (1 - share) * pdf)
        weight = dr.select((reconnected & ~free) | ~dr.isfinite(dr.sum(weight)), 0, weight)
        return Continuation(
            dr.select(reconnected, before.si.spawn_ray(link.direction), before.ray),
            dr.select(reconnected, link.image, piₚ),
            dr.select(mixed, weight, before.weight),
            dr.select(mixed, pdf, before.bs.pdf),
            before.delta & ~reconnected,
            dr.select(reconnected, 1, before.bs.eta),
            dr.select(reconnected, self.shared & ~moves(tables, pi.shape), coincides),
        )

    @property
    def _reconnects(self) -> bool:
        return self.max_depth > 2 and self.share > 0

    def _may_add(self, tables: Mapping[str, Any], path: PairState, ray: Any) -> Bool:
        """Return the lanes whose next segment may contribute: the last one must hit an emitter."""
        if tables["lights"] is None:
            return mi.Bool(True)
        return (path.depth + 2 < self.max_depth) | tables["lights"].meet(ray, mi.Float(dr.inf))

    def _roulette(self, depth: UInt32, β: Spectrum, η: Float, number: Float) -> tuple[Bool, Spectrum]:
        most = dr.max(β)
        q = dr.minimum(most * dr.square(η), 0.95)
        roulette = depth >= self.rr_depth
        return (most != 0) & (~roulette | (number < q)), β * dr.select(roulette, dr.rcp(q), 1)
