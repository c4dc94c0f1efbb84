# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""The surface path tracer: next-event estimation, multiple importance sampling, roulette, for one state or two, and its adjoint.

Symbols: β throughput, L radiance, δL adjoint radiance, η relative index of refraction, si surface interaction. A subscript ₚ
marks the previous state, which rides on the current state's paths (Nicolet et al. 2023, section 5 and appendix B).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

ROULETTE_FLOOR = 0.25
"""Roulette looks at the current throughput alone, so that the adjoint can replay it without the previous state. This floor
keeps paths alive that only the previous state still uses: both images stay unbiased whatever the ratio of throughputs."""


class PathPair:
    """Settings of the path tracer.

    Args:
        max_depth: the longest path in segments, as in Mitsuba (1: directly visible emitters only), >= 1.
        rr_depth: the depth from which roulette may end a path.
        changing_delta: whether a BSDF with a parameter to recover has perfectly specular lobes (a few evaluations more per bounce).

    Differences from Mitsuba's `path` that matter to the estimates, none to their means: a sampled direction is weighted by the
    BSDF's whole density and value (not by the sampled lobe's own), so that both states share one density; the visibility of
    an emitter is tested apart from its radiance, so that an emitter that is black in one state still counts in the other.
    """

    def __init__(self, max_depth: int, rr_depth: int = 5, changing_delta: bool = False):
        # No dataclass: Dr.Jit would take it for state of the loop below.
        self.max_depth = max_depth
        self.rr_depth = rr_depth
        self.changing_delta = changing_delta

    @dr.syntax
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
        """Trace one path per lane.

        Args:
            mode: `Primal`, or `Backward` to replay the paths of a primal pass and back-propagate `δL` into the parameters
                of `scene`, with `pair` also `δLₚ` into those of the previous scene (path replay, Vicini et al. 2021), or `Forward` to
                replay them and carry the tangents of the parameters of `scene` forward. Call under `dr.suspend_grad()`.
            scene: the current scene.
            tables: of `ScenePair.tables()`, used with `pair`; its "delta" entry, used with `changing_delta`.
            sampler: seeded; the same seed replays the same paths.
            ray: camera rays.
            δL: adjoint radiance per lane, with `Backward`.
            state_in: radiance per lane that the primal pass returned, with `Backward` and `Forward`.
            pair: whether the previous state rides along.
            δLₚ, stateₚ_in: likewise for the previous state, with `Backward` and `pair`.
            geometry: what rays meet in place of `scene` (`poses.Assembly`), or None.

        Returns:
            radiance of the current and of the previous state per lane, both unbiased; with `Forward` the derivative of the radiance
            along the tangents, and zero.
        """
        primal, forward = mode == dr.ADMode.Primal, mode == dr.ADMode.Forward
        geometry = scene if geometry is None else geometry
        follow_delta = self.changing_delta and (pair or not primal)
        bsdf_ctx = mi.BSDFContext()

        # --------------------- Configure loop state ----------------------
        ray = mi.Ray3f(dr.detach(ray))
        depth = mi.UInt32(0)
        L = mi.Spectrum(0 if primal else state_in)
        Lₚ = mi.Spectrum(stateₚ_in if stateₚ_in is not None else 0)
        δL = mi.Spectrum(δL if δL is not None else 0)
        δLₚ = mi.Spectrum(δLₚ if δLₚ is not None else 0)
        β = mi.Spectrum(1)
        βₚ = mi.Spectrum(1)
        η = mi.Float(1)
        active = mi.Bool(True)

        si_last = dr.zeros(mi.SurfaceInteraction3f)
        pdf_last = mi.Float(1)
        delta_last = mi.Bool(True)

        while dr.hint(active, max_iterations=self.max_depth, label=f"path pair ({mode.name})"):
            si = geometry.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=depth == 0, active=active)
            bsdf = si.bsdf(ray)

            # ---------------------- Direct emission ----------------------
            ds = mi.DirectionSample3f(scene, si=si, ref=si_last)
            mis = mis_weight(pdf_last, scene.pdf_emitter_direction(si_last, ds, ~delta_last))
            with dr.resume_grad(when=not primal):
                Le = β * mis * ds.emitter.eval(si, active)
            Leₚ = Ldₚ = mi.Spectrum(0)
            if dr.hint(pair, mode="scalar"):
                siₚ = mi.SurfaceInteraction3f(si)
                siₚ.shape = remap(mi.ShapePtr, tables["shape"], si.shape)
                emitterₚ = remap(mi.EmitterPtr, tables["emitter"], ds.emitter)
                with dr.resume_grad(when=not primal):
                    Leₚ = βₚ * mis * emitterₚ.eval(siₚ, active)

            # ---------------------- Emitter sampling ----------------------
            active_next = active & (depth + 1 < self.max_depth) & si.is_valid()
            active_em = active_next & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            ds, _ = scene.sample_emitter_direction(si, sampler.next_2d(), False, active_em)
            active_em &= ds.pdf != 0
            active_em &= ~geometry.ray_test(si.spawn_ray_to(ds.p), active_em)
            inv_pdf = dr.select(active_em, dr.rcp(ds.pdf), 0)
            wo = si.to_local(ds.d)
            with dr.resume_grad(when=not primal):
                f, pdf = bsdf.eval_pdf(bsdf_ctx, si, wo, active_em)
                mis_em = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
                em = scene.eval_emitter_direction(si, ds, active_em) * inv_pdf
                Ld = dr.select(active_em, β * mis_em * f * em, 0)
            if dr.hint(pair, mode="scalar"):
                bsdfₚ = remap(mi.BSDFPtr, tables["bsdf"], bsdf)
                emitterₚ = remap(mi.EmitterPtr, tables["emitter"], ds.emitter)
                with dr.resume_grad(when=not primal):
                    fₚ = bsdfₚ.eval(bsdf_ctx, siₚ, wo, active_em)
                    emₚ = emitterₚ.eval_direction(siₚ, ds, active_em) * inv_pdf
                    Ldₚ = dr.select(active_em, βₚ * mis_em * fₚ * emₚ, 0)

            # ------------------ Detached BSDF sampling -------------------
            sample_1, sample_2 = sampler.next_1d(), sampler.next_2d()
            bs, weight = bsdf.sample(bsdf_ctx, si, sample_1, sample_2, active_next)
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            smooth = active_next & ~delta
            if dr.hint(follow_delta, mode="scalar"):
                kind = dr.gather(mi.UInt32, tables["delta"], dr.reinterpret_array(mi.UInt32, bsdf), active_next)
            with dr.resume_grad(when=not primal):
                f, pdf = bsdf.eval_pdf(bsdf_ctx, si, bs.wo, smooth)
            inv_pdf = dr.select(smooth & (pdf > 0), dr.rcp(pdf), 0)
            weight = dr.select(delta, weight, dr.detach(f) * inv_pdf)
            if dr.hint(pair, mode="scalar"):
                with dr.resume_grad(when=not primal):
                    valueₚ = bsdfₚ.eval(bsdf_ctx, siₚ, bs.wo, smooth)
                weightₚ = dr.select(delta, weight, dr.detach(valueₚ) * inv_pdf)
                if dr.hint(follow_delta, mode="scalar"):
                    with dr.resume_grad(when=not primal):
                        lobeₚ = self._delta_value(kind, bsdfₚ, siₚ, bs, sample_1, sample_2, active_next & delta)
                        valueₚ = dr.select(delta, lobeₚ, valueₚ)
                    changed = delta & (kind != DELTA_EQUAL)
                    weightₚ = dr.select(changed, dr.detach(lobeₚ) * dr.select(bs.pdf > 0, dr.rcp(bs.pdf), 0), weightₚ)

            # ---- Update loop variables based on current interaction -----
            L = (L + Le + Ld) if primal else (L - Le - Ld)
            if dr.hint(pair, mode="scalar"):
                Lₚ = (Lₚ + Leₚ + Ldₚ) if primal else (Lₚ - Leₚ - Ldₚ)
            if dr.hint(not primal, mode="scalar"):
                with dr.resume_grad():
                    # L now holds what arrives through the sampled direction: times f / detach(f) it carries f's derivative.
                    value = f
                    if dr.hint(follow_delta, mode="scalar"):
                        lobe = self._delta_value(kind, bsdf, si, bs, sample_1, sample_2, active_next & delta)
                        value = dr.select(delta, lobe, f)
                    Lo = Le + Ld + L * relative(value)
                    if dr.hint(forward, mode="scalar"):
                        δL += dr.forward_to(Lo)
                    else:
                        Lo = δL * Lo
                        if dr.hint(pair, mode="scalar"):
                            Lo += δLₚ * (Leₚ + Ldₚ + Lₚ * relative(valueₚ))
                        dr.backward_from(Lo)
            ray = si.spawn_ray(si.to_world(bs.wo))
            η *= bs.eta
            β *= weight
            if dr.hint(pair, mode="scalar"):
                βₚ *= weightₚ
            si_last = dr.detach(si, True)
            pdf_last = dr.select(delta, 1, pdf)  # no emitter sample competes with a delta lobe
            delta_last = delta

            # -------------------- Stopping criterion ---------------------
            β_max = dr.max(β)
            if dr.hint(pair, mode="scalar"):
                active_next &= (β_max > 0) | (dr.max(βₚ) > 0)
            else:
                active_next &= β_max > 0
            q = dr.clip(β_max * dr.square(η), ROULETTE_FLOOR, 0.95)
            roulette = depth >= self.rr_depth
            rr_weight = dr.select(roulette, dr.rcp(q), 1)
            β *= rr_weight
            βₚ *= rr_weight
            active_next &= ~roulette | (sampler.next_1d() < q)
            depth[si.is_valid()] += 1
            active = active_next

        return δL if forward else L, Lₚ

    def _delta_value(self, kind, bsdf, si, bs, sample_1, sample_2, active):
        """The value of the perfectly specular lobe that was sampled, which no BSDF evaluation returns.

        A conductor's, dielectric's or plastic's is had by sampling that lobe alone, with probability one; a mask's null lobe from
        its null transmission. 1 for BSDFs whose specular lobes do not change. Its derivative is that of the lobe, not of the
        probability of choosing it, which the weight of an attached sample would add.
        """
        value = mi.Spectrum(1)
        for lobe in mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.Null:
            chosen = active & (kind == DELTA_SIMPLE) & mi.has_flag(bs.sampled_type, lobe)
            ctx = mi.BSDFContext()
            ctx.type_mask = +lobe
            again, weight = bsdf.sample(ctx, si, sample_1, sample_2, chosen)
            value = dr.select(chosen, weight * dr.detach(again.pdf), value)
        chosen = active & (kind == DELTA_MASK) & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        return dr.select(chosen, bsdf.eval_null_transmission(si, chosen), value)


DELTA_EQUAL, DELTA_SIMPLE, DELTA_MASK = 0, 1, 2
"""Entries of `tables["delta"]`: how a BSDF's perfectly specular lobes follow a change of its parameters."""


def remap(pointer: type, table: Any, source: Any) -> Any:
    """The previous state's object for the current state's `source`, of type `pointer` (`mi.BSDFPtr`, ...)."""
    return dr.reinterpret_array(pointer, dr.gather(mi.UInt32, table, dr.reinterpret_array(mi.UInt32, source)))


def mis_weight(pdf_a: Any, pdf_b: Any) -> Any:
    """The power heuristic with exponent 2, detached."""
    a, b = dr.square(pdf_a), dr.square(pdf_b)
    return dr.detach(dr.select(a > 0, a / (a + b), 0))


def relative(value: Any) -> Any:
    """value / detach(value), 0 where it is zero: one, with the derivative of the logarithm."""
    primal = dr.detach(value)
    return dr.select(primal != 0, value / primal, 0)
