# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false, reportCallIssue=false, reportOptionalMemberAccess=false

"""The volumetric path tracer: surfaces as in `path_pair.py`, and participating media, for one state or two, and its adjoint.

Symbols as there, and: T transmittance, σₜ extinction, σₛ scattering, σ̄ majorant. A vertex is where a path scatters, on a surface or
in a medium; boundaries that let light pass straight on are no vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.film import RepeatingSampler
from unrender.rendering.mitsuba.integrators import tracking
from unrender.rendering.mitsuba.integrators.path import DELTA_EQUAL, PathPair, mis_weight, relative, remap
from unrender.rendering.mitsuba.integrators.tracking import Reservoir

_KEEP = dr.ADFlag.ClearInput | dr.ADFlag.ClearInterior
"""Two passes go the way from what the scene makes of its parameters (such as padded texels) back to them: the first must not use it up."""


class VolumePair:
    """Settings of the volumetric path tracer.

    Args:
        max_depth: the longest path in segments, as in Mitsuba's `volpath` (1: directly visible emitters only), >= 1.
        rr_depth: the depth from which roulette may end a path.
        changing_delta: as for `PathPair`.
        differentiate_media: whether parameters of media are to be recovered: only then is their derivative looked for.
        emission: whether there are media that emit (`emissive.py`).

    Collisions, directions and roulette depend on both states, so the adjoint of a pair needs both (`adjoint_pair`), also where only
    one gradient is wanted.

    *The derivative of a medium.* Along a segment of length D, with L(t) arriving from beyond t and Lₛ(t) scattered into it,

        ∂L = ∫ T(t) (∂σₛ(t) Lₛ(t) - ∂σₜ(t) L(t)) dt + (what the path's other vertices give)

    The second term is -C ∫ ∂σₜ over the part of the segment that was flown, for a path that contributes C: the integral is estimated by one
    point, uniform and independent of the collisions that C is made of. The first is found twice, at the path's
    own collisions and, where σₛ is small, by differential ratio tracking (`update_reservoir`), weighted by σₛ/(σₛ + c) and c/(σₛ + c):
    neither divides by σₛ or σₜ, nor by σ̄ - σₜ. So gradients are unbiased wherever density or albedo is zero, and where
    density is at the majorant.
    """

    def __init__(
        self,
        max_depth: int,
        rr_depth: int = 5,
        changing_delta: bool = False,
        differentiate_media: bool = True,
        emission: bool = False,
    ):
        # No dataclass: Dr.Jit would take it for state of the loop below.
        self.max_depth = max_depth
        self.rr_depth = rr_depth
        self.changing_delta = changing_delta
        self.differentiate_media = differentiate_media
        self.emission = emission
        self._surfaces = PathPair(max_depth, rr_depth, changing_delta)

    def sample(
        self,
        mode: dr.ADMode,
        scene: Any,
        tables: Any,
        sampler: Any,
        ray: Any,
        δL: Any = None,
        state_in: Any = None,
        pair: bool = False,
        δLₚ: Any = None,
        stateₚ_in: Any = None,
        geometry: Any = None,
    ) -> tuple[Any, Any]:
        """Trace one path per lane. See `PathPair.sample`; `tables` has also the entries of `ScenePair.media()` and `.majorants()`.

        `geometry` must be None: posed shapes and media do not meet.
        """
        assert geometry is None
        camera_medium = dr.reinterpret_array(mi.MediumPtr, tables["camera"])
        start = Start(mi.Ray3f(dr.detach(ray)), camera_medium, mi.UInt32(0), mi.Bool(True))
        if mode == dr.ADMode.Primal:
            L, Lₚ, _ = self._trace(mode, scene, tables, sampler, start, pair)
            return L, Lₚ
        noise = independent(sampler, dr.width(ray))
        states = (state_in, stateₚ_in, δL, δLₚ)
        L, Lₚ, kept = self._trace(mode, scene, tables, sampler, start, pair, *states, noise=noise)
        if self.differentiate_media:
            dr.eval(kept)  # Two backward passes in one kernel would race for the same gradients.
            scattered = self._in_scattering(mode, scene, tables, noise, kept, δL, δLₚ, pair)
            if mode == dr.ADMode.Forward:
                L += scattered
        return L, Lₚ

    @dr.syntax
    def _trace(
        self,
        mode: dr.ADMode,
        scene: Any,
        tables: Any,
        sampler: Any,
        start: Start,
        pair: bool,
        state_in: Any = None,
        stateₚ_in: Any = None,
        δL: Any = None,
        δLₚ: Any = None,
        noise: Any = None,
    ) -> tuple[Any, Any, Any]:
        """A path from `start` on; otherwise its replay, and what differential ratio tracking keeps of it."""
        primal, forward = mode == dr.ADMode.Primal, mode == dr.ADMode.Forward
        follow_delta = self.changing_delta and (pair or not primal)
        follow_media = self.differentiate_media and not primal
        bsdf_ctx = mi.BSDFContext()
        phase_ctx = mi.PhaseFunctionContext()

        # --------------------- Configure loop state ----------------------
        ray = mi.Ray3f(start.ray)
        medium = mi.MediumPtr(start.medium)
        depth = mi.UInt32(start.depth)
        L = mi.Spectrum(0 if primal else state_in)
        Lₚ = mi.Spectrum(stateₚ_in if stateₚ_in is not None else 0)
        δL = mi.Spectrum(δL if δL is not None else 1)
        δLₚ = mi.Spectrum(δLₚ if δLₚ is not None else 1)
        along = mi.Spectrum(0)  # the derivative along the tangents
        β = mi.Spectrum(1)
        βₚ = mi.Spectrum(1)
        η = mi.Float(1)
        active = mi.Bool(start.active)
        kept = Reservoir.empty()
        forced = mi.Bool(start.t is not None)

        vertex_last = dr.zeros(mi.Interaction3f)
        pdf_last = mi.Float(1)
        delta_last = mi.Bool(True)

        while dr.hint(active, label=f"volume pair ({mode.name})"):
            si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=depth == 0, active=active)

            # ------------------------ Free flight ------------------------
            mediumₚ = medium
            if dr.hint(pair, mode="scalar"):
                mediumₚ = remap(mi.MediumPtr, tables["medium"], medium)
            inside = active & (medium != None)  # noqa: E711 (a comparison per lane)
            near, far = tracking.clip_segment(medium, ray, si.t, inside)
            bound = tracking.bounds(tables, medium, mediumₚ, ray, near, far, inside, pair)
            may_scatter = active & (depth + 1 < self.max_depth)
            shines = mi.Bool(False)
            if dr.hint(self.emission, mode="scalar"):
                shines = dr.gather(mi.UInt32, tables["emits"], dr.reinterpret_array(mi.UInt32, medium), inside) != 0
            if dr.hint(follow_media, mode="scalar"):
                offers = inside & (may_scatter | shines)
                kept = tracking.update_reservoir(kept, medium, mediumₚ, ray, bound, depth, β, βₚ, noise, offers, pair)
            flies = inside & ~forced
            t, scatters, β, βₚ = tracking.sample_free_flight(medium, mediumₚ, ray, bound, β, βₚ, sampler, flies, pair)
            if dr.hint(start.t is not None, mode="scalar"):
                t = dr.select(forced, start.t, t)
                scatters |= forced
                forced &= False
            mei = tracking.at(ray, t)
            Lo = mi.Spectrum(0)
            if dr.hint(follow_media, mode="scalar"):
                end = dr.select(scatters, t, far)
                middle = tracking.at(ray, near + noise.next_1d() * (end - near))
                c = tracking.balance(near, far)
                with dr.resume_grad():
                    Lo += δL * L * medium_derivative(medium, mei, middle, end - near, c, scatters, inside)
                    if dr.hint(pair, mode="scalar"):
                        Lo += δLₚ * Lₚ * medium_derivative(mediumₚ, mei, middle, end - near, c, scatters, inside)

            # ---------------------- Direct emission ----------------------
            escaped = active & ~scatters
            Lm = Lmₚ = mi.Spectrum(0)
            if dr.hint(self.emission, mode="scalar"):
                # What a medium emits takes the place of what it scatters: it is in the throughput already. The path ends.
                Lm, Lmₚ = dr.select(scatters & shines, β, 0), dr.select(scatters & shines, βₚ, 0)
                scatters &= ~shines
            bsdf = si.bsdf(ray)
            ds = mi.DirectionSample3f(scene, si=si, ref=vertex_last)
            mis = mis_weight(pdf_last, scene.pdf_emitter_direction(vertex_last, ds, escaped & ~delta_last))
            with dr.resume_grad(when=not primal):
                Le = β * mis * ds.emitter.eval(si, escaped)
            Leₚ = Ldₚ = mi.Spectrum(0)
            if dr.hint(pair, mode="scalar"):
                siₚ = mi.SurfaceInteraction3f(si)
                siₚ.shape = remap(mi.ShapePtr, tables["shape"], si.shape)
                emitterₚ = remap(mi.EmitterPtr, tables["emitter"], ds.emitter)
                with dr.resume_grad(when=not primal):
                    Leₚ = βₚ * mis * emitterₚ.eval(siₚ, escaped)

            # ---------------------- Emitter sampling ----------------------
            scatters &= may_scatter
            # At the last depth a boundary can still let light straight on.
            meets = escaped & si.is_valid() & (may_scatter | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null))
            phase = medium.phase_function()
            connects = medium.use_emitter_sampling()
            at_medium = scatters & connects
            at_surface = meets & may_scatter & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            active_em = at_medium | at_surface
            vertex = dr.select(scatters, mi.Interaction3f(mei), mi.Interaction3f(si))
            ds, _ = scene.sample_emitter_direction(vertex, sampler.next_2d(), False, active_em)
            active_em &= ds.pdf != 0
            outside = dr.select(at_surface & si.is_medium_transition(), si.target_medium(ds.d), medium)
            T, Tₚ, way = self._connect(scene, tables, sampler, vertex, ds.p, outside, active_em, pair, noise)
            inv_pdf = dr.select(active_em, dr.rcp(ds.pdf), 0)
            wo = si.to_local(ds.d)
            at_medium &= active_em
            at_surface &= active_em
            with dr.resume_grad(when=not primal):
                f, pdf = bsdf.eval_pdf(bsdf_ctx, si, wo, at_surface)
                fₘ, pdfₘ = phase.eval_pdf(phase_ctx, mei, ds.d, at_medium)
                f, pdf = dr.select(at_medium, fₘ, f), dr.select(at_medium, pdfₘ, pdf)
                mis_em = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
                em = scene.eval_emitter_direction(vertex, ds, active_em) * inv_pdf
                Ld = dr.select(active_em, β * T * mis_em * f * em, 0)
            if dr.hint(pair, mode="scalar"):
                bsdfₚ = remap(mi.BSDFPtr, tables["bsdf"], bsdf)
                phaseₚ = mediumₚ.phase_function()
                emitterₚ = remap(mi.EmitterPtr, tables["emitter"], ds.emitter)
                with dr.resume_grad(when=not primal):
                    fₚ = bsdfₚ.eval(bsdf_ctx, siₚ, wo, at_surface)
                    fₚ = dr.select(at_medium, phaseₚ.eval_pdf(phase_ctx, mei, ds.d, at_medium)[0], fₚ)
                    emₚ = emitterₚ.eval_direction(vertex, ds, active_em) * inv_pdf
                    Ldₚ = dr.select(active_em, βₚ * Tₚ * mis_em * fₚ * emₚ, 0)
            if dr.hint(follow_media, mode="scalar"):
                with dr.resume_grad():
                    Lo -= δL * dr.detach(Ld) * way.depth(way.medium)
                    if dr.hint(pair, mode="scalar"):
                        Lo -= δLₚ * dr.detach(Ldₚ) * way.depth(remap(mi.MediumPtr, tables["medium"], way.medium))

            # ---------------- Detached sampling of a direction ----------------
            sample_1, sample_2 = sampler.next_1d(), sampler.next_2d()
            bs, weight = bsdf.sample(bsdf_ctx, si, sample_1, sample_2, meets)
            woₘ, _, pdfₘ = phase.sample(phase_ctx, mei, sample_1, sample_2, scatters)
            delta = meets & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            null = delta & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            smooth = meets & ~delta
            if dr.hint(follow_delta, mode="scalar"):
                kind = dr.gather(mi.UInt32, tables["delta"], dr.reinterpret_array(mi.UInt32, bsdf), meets)
            with dr.resume_grad(when=not primal):
                f, pdf = bsdf.eval_pdf(bsdf_ctx, si, bs.wo, smooth)
                fₘ, _ = phase.eval_pdf(phase_ctx, mei, woₘ, scatters)
                f = dr.select(scatters, fₘ, f)
            pdf = dr.select(scatters, pdfₘ, pdf)
            inv_pdf = dr.select((smooth | scatters) & (pdf > 0), dr.rcp(pdf), 0)
            weight = dr.select(delta, weight, dr.detach(f) * inv_pdf)
            if dr.hint(pair, mode="scalar"):
                with dr.resume_grad(when=not primal):
                    valueₚ = bsdfₚ.eval(bsdf_ctx, siₚ, bs.wo, smooth)
                    valueₚ = dr.select(scatters, phaseₚ.eval_pdf(phase_ctx, mei, woₘ, scatters)[0], valueₚ)
                weightₚ = dr.select(delta, weight, dr.detach(valueₚ) * inv_pdf)
                if dr.hint(follow_delta, mode="scalar"):
                    with dr.resume_grad(when=not primal):
                        lobeₚ = self._surfaces._delta_value(kind, bsdfₚ, siₚ, bs, sample_1, sample_2, delta)
                        valueₚ = dr.select(delta, lobeₚ, valueₚ)
                    changed = delta & (kind != DELTA_EQUAL)
                    weightₚ = dr.select(changed, dr.detach(lobeₚ) * dr.select(bs.pdf > 0, dr.rcp(bs.pdf), 0), weightₚ)

            # ---- Update loop variables based on current interaction -----
            L = (L + Le + Ld + Lm) if primal else (L - Le - Ld - Lm)
            if dr.hint(pair, mode="scalar"):
                Lₚ = (Lₚ + Leₚ + Ldₚ + Lmₚ) if primal else (Lₚ - Leₚ - Ldₚ - Lmₚ)
            if dr.hint(not primal, mode="scalar"):
                with dr.resume_grad():
                    # L now holds what arrives through the sampled direction: times f / detach(f) it carries f's derivative.
                    value = f
                    if dr.hint(follow_delta, mode="scalar"):
                        lobe = self._surfaces._delta_value(kind, bsdf, si, bs, sample_1, sample_2, delta)
                        value = dr.select(delta, lobe, f)
                    Lo += δL * (Le + Ld + L * relative(value))
                    if dr.hint(pair, mode="scalar"):
                        Lo += δLₚ * (Leₚ + Ldₚ + Lₚ * relative(valueₚ))
                    if dr.hint(forward, mode="scalar"):
                        along += dr.forward_to(Lo)
                    else:
                        dr.backward_from(Lo, flags=_KEEP)
            η *= dr.select(meets, bs.eta, 1)
            β *= weight
            if dr.hint(pair, mode="scalar"):
                βₚ *= weightₚ
            moved = scatters | (meets & ~null)
            ray = dr.select(scatters, mi.Interaction3f(mei).spawn_ray(woₘ), si.spawn_ray(si.to_world(bs.wo)))
            medium = dr.select(meets & si.is_medium_transition(), si.target_medium(ray.d), medium)
            vertex_last = dr.select(moved, dr.detach(vertex), vertex_last)
            delta_last = dr.select(moved, delta | (scatters & ~connects), delta_last)
            pdf_last = dr.select(moved, dr.select(delta, 1, pdf), pdf_last)

            # -------------------- Stopping criterion ---------------------
            most = dr.max(β)
            if dr.hint(pair, mode="scalar"):
                most = dr.maximum(most, dr.max(βₚ))
            q = dr.clip(most * dr.square(η), 0.05, 0.95)
            roulette = moved & (depth >= self.rr_depth)
            rr_weight = dr.select(roulette, dr.rcp(q), 1)
            β *= rr_weight
            βₚ *= rr_weight
            active = (scatters | (meets & (may_scatter | null))) & (most > 0) & (~roulette | (sampler.next_1d() < q))
            depth[moved] += 1

        return along if forward else L, Lₚ, kept

    @dr.syntax
    def _connect(
        self,
        scene: Any,
        tables: Any,
        sampler: Any,
        vertex: Any,
        target: Any,
        medium: Any,
        active: Any,
        pair: bool,
        noise: Any,
    ) -> tuple[Any, Any, Any]:
        """What passes from `vertex` to `target` in both states: through media, and boundaries that let light straight on.

        With `noise`, also a point of the way, uniform over its length inside media.
        """
        ray = vertex.spawn_ray_to(target)
        medium = mi.MediumPtr(medium)
        active = mi.Bool(active)
        T = mi.Spectrum(1)
        Tₚ = mi.Spectrum(1)
        way = ConnectionSample(dr.zeros(mi.Ray3f), mi.Float(0), dr.zeros(mi.MediumPtr), mi.Float(0))
        follow = noise is not None and self.differentiate_media
        while dr.hint(active, label="emitter connection"):
            si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=False, active=active)
            mediumₚ = medium
            if dr.hint(pair, mode="scalar"):
                mediumₚ = remap(mi.MediumPtr, tables["medium"], medium)
            inside = active & (medium != None)  # noqa: E711 (a comparison per lane)
            near, far = tracking.clip_segment(medium, ray, dr.minimum(si.t, ray.maxt), inside)
            bound = tracking.bounds(tables, medium, mediumₚ, ray, near, far, inside, pair)
            passed, passedₚ = tracking.estimate_transmittance(medium, mediumₚ, ray, bound, sampler, inside, pair)
            if dr.hint(follow, mode="scalar"):
                length = far - near
                way.length += length
                take = noise.next_1d() * way.length < length
                way.ray = dr.select(take, ray, way.ray)
                way.medium = dr.select(take, medium, way.medium)
                way.t = dr.select(take, near + noise.next_1d() * length, way.t)

            hit = active & si.is_valid()
            bsdf = si.bsdf()
            T *= dr.select(active, passed, 1) * dr.select(hit, bsdf.eval_null_transmission(si, hit), 1)
            most = dr.max(T)
            if dr.hint(pair, mode="scalar"):
                siₚ = mi.SurfaceInteraction3f(si)
                siₚ.shape = remap(mi.ShapePtr, tables["shape"], si.shape)
                bsdfₚ = remap(mi.BSDFPtr, tables["bsdf"], bsdf)
                Tₚ *= dr.select(active, passedₚ, 1) * dr.select(hit, bsdfₚ.eval_null_transmission(siₚ, hit), 1)
                most = dr.maximum(most, dr.max(Tₚ))
            active = hit & (most > 0)
            medium = dr.select(active & si.is_medium_transition(), si.target_medium(ray.d), medium)
            ray = dr.select(active, si.spawn_ray_to(target), ray)
        return T, Tₚ, way

    def _in_scattering(
        self, mode: dr.ADMode, scene: Any, tables: Any, noise: Any, kept: Reservoir, δL: Any, δLₚ: Any, pair: bool
    ) -> Any:
        """Back-propagate the derivative of the scattering at the kept point, whose light is found by a path of its own; with `Forward`
        the derivative along the tangents is returned."""
        start = Start(kept.ray, kept.medium, kept.depth, kept.total > 0, kept.t)
        L, Lₚ, _ = self._trace(dr.ADMode.Primal, scene, tables, noise, start, pair)
        share = dr.select(kept.weight > 0, kept.total / kept.weight, 0)
        mei = tracking.at(kept.ray, kept.t)
        with dr.resume_grad():
            σₛ = kept.medium.get_scattering_coefficients(mei, start.active)[0]
            Lo = L * kept.β * share * σₛ
            if mode == dr.ADMode.Forward:
                return dr.forward_to(Lo)
            Lo *= δL
            if pair:
                mediumₚ = remap(mi.MediumPtr, tables["medium"], kept.medium)
                Lo += δLₚ * Lₚ * kept.βₚ * share * mediumₚ.get_scattering_coefficients(mei, start.active)[0]
            dr.backward_from(Lo, flags=_KEEP)
        return None


class Start:
    """Where paths begin: on rays, or in a medium at distance `t` along rays, where they scatter first.

    Attributes:
        ray: `mi.Ray3f`.
        medium: `mi.MediumPtr` at its origin.
        depth: of what lies before.
        active: which lanes have one.
        t: None, or where to scatter.
    """

    def __init__(self, ray: Any, medium: Any, depth: Any, active: Any, t: Any = None):
        self.ray, self.medium, self.depth, self.active, self.t = ray, medium, depth, active, t


@dataclass
class ConnectionSample:
    """One point of a connection, uniform over its length inside media. State of a Dr.Jit loop, hence mutable.

    Attributes:
        ray: it lies at `t` along this one.
        t: distance.
        medium: where it lies; null where the connection meets no medium.
        length: inside media.
    """

    ray: Any
    t: Any
    medium: Any
    length: Any

    def depth(self, medium: Any) -> Any:
        """The optical depth that this point stands for, in `medium`. Its derivative is that of -log T, unbiased."""
        return self.length * medium.get_scattering_coefficients(tracking.at(self.ray, self.t), self.length > 0)[2]


def medium_derivative(medium: Any, collision: Any, middle: Any, flown: Any, c: Any, scatters: Any, inside: Any) -> Any:
    """What the derivative of a path's contribution by a segment inside a medium is, as a share of the contribution.

    Args:
        medium: of the segment.
        collision: where it ends, if it `scatters`.
        middle: a uniform point of what was flown.
        flown: the length of that.
        c: see `tracking.balance`.
    """
    depth = flown * medium.get_scattering_coefficients(middle, inside)[2]
    σₛ = medium.get_scattering_coefficients(collision, scatters)[0]
    total = dr.detach(σₛ) + c
    return dr.select(scatters & (total > 0), σₛ / total, 0) - depth


def independent(sampler: Any, lanes: int) -> RepeatingSampler:
    """Random numbers apart from those of the path, which is replayed and must meet its own again."""
    copy = sampler.clone()
    bits = dr.reinterpret_array(mi.UInt32, copy.next_1d())
    state, sequence = mi.sample_tea_32(bits, dr.arange(mi.UInt32, lanes))
    return RepeatingSampler(lanes, mi.PCG32(1, mi.UInt64(state), mi.UInt64(sequence)))
