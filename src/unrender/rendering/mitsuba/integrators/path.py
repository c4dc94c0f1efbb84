"""Surface path tracer for one state or two, and its adjoint: next-event estimation, multiple importance sampling, Russian roulette.

Symbols: β throughput, L radiance, δL adjoint radiance, η relative index of refraction, si surface interaction. β, L and all other
quantities that differ between the states are lists, the current state first. The previous state is traced on the current state's paths.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators import emitters, specular
from unrender.rendering.mitsuba.integrators.base import (
    KEEP,
    Bool,
    ConnectionRecord,
    Float,
    PathContext,
    ScatteringVertex,
    Spectrum,
    UInt32,
    carries_light,
    relative,
    total,
    while_loop,
)
from unrender.rendering.mitsuba.integrators.differential_bsdf import BranchVertex, DifferentialBsdf, RoughLobe
from unrender.rendering.mitsuba.samplers import independent

ROULETTE_FLOOR = 0.25
"""Minimum survival probability of Russian roulette, which depends on the current throughput only, so that the adjoint can replay it
without the previous state. The floor keeps paths that only the previous state needs: both images are unbiased for any throughputs."""


@dataclass
class PathState:
    """Loop state of a path.

    L is the radiance of each state: accumulated so far or, in a replay, remaining. In forward mode, δL is its derivative along the
    tangents, and δlogβ that of the logarithm of the throughput, if connections are recorded.
    """

    ray: mi.Ray3f
    depth: UInt32
    L: list[Spectrum]
    δL: Spectrum
    δlogβ: Spectrum
    β: list[Spectrum]
    η: Float
    last: ScatteringVertex
    active: Bool
    branches: list[BranchVertex] = field(default_factory=list)


class BsdfDirection:
    """A direction sampled from a BSDF, with the solid angle density of all smooth lobes together.

    For each state, `values` are BSDF times cosine, or the value of a specular lobe that depends on parameters, attached; `weights` are
    detached.
    """

    def __init__(self, bs: mi.BSDFSample3f, pdf: Float, delta: Bool, values: list[Spectrum], weights: list[Spectrum]):
        self.bs, self.pdf, self.delta, self.values, self.weights = bs, pdf, delta, values, weights


class PathPair:
    """Path tracer of surfaces.

    Args:
        max_depth: maximum path length in segments, as in Mitsuba (1: directly visible emitters only), >= 1.
        rr_depth: depth from which Russian roulette may terminate a path.
        changing_delta: whether a BSDF with an unknown parameter has perfectly specular lobes, which need further evaluations per bounce.
        differential: differential sampling of roughness in replays of one state; None for standard sampling. It needs the entry "rough" of
            `tables`.
        turning_emitters: whether the rotation of an environment is an unknown with derivatives.

    Differences from Mitsuba's `path`, which do not change expected values: a sampled direction is weighted by the BSDF's total density
    and value, not by those of the sampled lobe, so that both states share one density; and the visibility of an emitter is tested
    separately from its radiance, so that an emitter that is black in one state still contributes in the other.
    """

    def __init__(
        self,
        max_depth: int,
        rr_depth: int = 5,
        changing_delta: bool = False,
        differential: DifferentialBsdf | None = None,
        turning_emitters: bool = False,
    ):
        # This is not a dataclass, since Dr.Jit would treat a dataclass as state of the loop below.
        self.max_depth = max_depth
        self.rr_depth = rr_depth
        self.changing_delta = changing_delta
        self.differential = differential
        self.turning_emitters = turning_emitters

    def sample(
        self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f, active: Bool | bool = True
    ) -> tuple[Spectrum, Spectrum | None]:
        """Trace one path per lane, see `PathKernel.sample`. The "delta" entry of `tables` is used with `changing_delta`."""
        path, _ = while_loop(**self._loop(context, self._begin(context, ray, active), sampler))
        if path.branches:
            self._follow_branches(context, path, sampler)
        return path.δL if context.forward else path.L[0], path.L[1] if context.pair else None

    def vertices(self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f) -> Float:
        path, _ = while_loop(**self._loop(context, self._begin(context, ray), sampler))
        return mi.Float(path.depth)

    def record_connections(
        self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f, active: Bool | bool = True
    ) -> ConnectionRecord | None:
        """Replay the paths in forward mode, and return the contributions of emitter-sampling connections."""
        while_loop(**self._loop(context, self._begin(context, ray, active), sampler))
        return context.connections

    def _begin(self, context: PathContext, ray: mi.RayDifferential3f, active: Bool | bool = True) -> PathState:
        branches = self.differential is not None and not context.primal and not context.pair
        return PathState(
            ray=mi.Ray3f(dr.detach(ray)),
            depth=mi.UInt32(0),
            L=context.initial_radiance(),
            δL=mi.Spectrum(0),
            δlogβ=mi.Spectrum(0),
            β=[mi.Spectrum(1) for _ in range(context.state_count)],
            η=mi.Float(1),
            last=ScatteringVertex(dr.zeros(mi.SurfaceInteraction3f), mi.Float(1), mi.Bool(True)),
            active=mi.Bool(active),
            branches=[BranchVertex.nowhere(mi.Ray3f(dr.detach(ray)))] if branches else [],
        )

    def _loop(self, context: PathContext, path: PathState, sampler: Any) -> dict[str, Any]:
        """Return the arguments of the `dr.while_loop` over the segments of the paths; it returns path and sampler."""
        return {
            "state": (path, sampler),
            "cond": lambda path, sampler: path.active,
            "body": functools.partial(self._bounce, context),
            "max_iterations": self.max_depth,
            "label": f"path pair ({context.mode.name})",
        }

    def _bounce(self, context: PathContext, path: PathState, sampler: Any) -> tuple[PathState, Any]:
        si = context.geometry.ray_intersect(
            path.ray, ray_flags=mi.RayFlags.All, coherent=path.depth == 0, active=path.active
        )
        surfaces, bsdfs = context.states.interactions(si), context.states.bsdfs(si.bsdf(path.ray))  # pyright: ignore[reportArgumentType]

        materials = context.materials(surfaces)

        # ---------------------- Direct emission ----------------------
        Le = emitters.direct_emission(context, path.last, surfaces, path.β, path.active)

        # ---------------------- Emitter sampling ----------------------
        active_next = path.active & (path.depth + 1 < self.max_depth) & si.is_valid()
        lobe = self._rough_lobe(context, path, materials[0], bsdfs[0], active_next)
        Ld, connection = self._sample_emitter(
            context, path.β, surfaces[0], materials, bsdfs, sampler, active_next, lobe
        )

        # ------------------ Detached BSDF sampling -------------------
        direction = self._sample_bsdf(context, materials, bsdfs, sampler, active_next, lobe)
        bs = direction.bs

        # ---- Update loop variables based on current interaction -----
        path.L = context.accumulate(path.L, Le, Ld)
        if context.connections is not None:
            self._record(context.connections, path, connection, (Le[0], Ld[0], direction.values[0]))
        elif not context.primal:
            self._differentiate(context, path, Le, Ld, direction.values)
        path.ray = si.spawn_ray(si.to_world(bs.wo))
        path.η *= bs.eta
        path.β = [β * weight for β, weight in zip(path.β, direction.weights, strict=True)]
        pdf = dr.select(direction.delta, 1, direction.pdf)  # emitter sampling cannot sample a delta lobe
        path.last = ScatteringVertex(dr.detach(si, True), pdf, direction.delta)

        # -------------------- Stopping criterion ---------------------
        active_next &= carries_light(path.β)
        q = dr.clip(dr.max(path.β[0]) * dr.square(path.η), ROULETTE_FLOOR, 0.95)
        roulette = path.depth >= self.rr_depth
        rr_weight = dr.select(roulette, dr.rcp(q), 1)
        path.β = [β * rr_weight for β in path.β]
        active_next &= ~roulette | (sampler.next_1d() < q)
        path.depth[si.is_valid()] += 1
        path.active = active_next
        return path, sampler

    def _sample_emitter(
        self,
        context: PathContext,
        β: Sequence[Spectrum],
        si: mi.SurfaceInteraction3f,
        materials: Sequence[mi.SurfaceInteraction3f],
        bsdfs: Sequence[mi.BSDFPtr],
        sampler: Any,
        active: Bool,
        lobe: RoughLobe | None,
    ) -> tuple[list[Spectrum], emitters.EmitterConnection]:
        """Return Ld of each state, by next-event estimation."""
        bsdf, bsdf_ctx = bsdfs[0], context.bsdf_ctx
        active_em = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        connection = emitters.EmitterConnection(context, si, sampler.next_2d(), active_em, self.turning_emitters)
        ds = connection.ds
        connection.active &= ~context.geometry.ray_test(si.spawn_ray_to(ds.p), connection.active)
        wo = si.to_local(ds.d)
        with context.resume_grad():
            f, pdf = bsdf.eval_pdf(bsdf_ctx, materials[0], wo, connection.active)
            previous = [
                bsdfₚ.eval(bsdf_ctx, siₚ, wo, connection.active)
                for bsdfₚ, siₚ in zip(bsdfs[1:], materials[1:], strict=True)
            ]
            if lobe is None:
                return connection.contributions(β, [f, *previous], pdf), connection
            # For the derivative of the lobe, MIS combines these samples with the directions of the branches.
            rest = connection.contributions(β, [lobe.without(f, wo)], pdf)
            change = connection.contributions(β, [lobe.change(f, wo)], lobe.pdf(wo))
            return [total([*rest, *change])], connection

    def _sample_bsdf(
        self,
        context: PathContext,
        materials: Sequence[mi.SurfaceInteraction3f],
        bsdfs: Sequence[mi.BSDFPtr],
        sampler: Any,
        active: Bool,
        lobe: RoughLobe | None,
    ) -> BsdfDirection:
        si, bsdf, bsdf_ctx = materials[0], bsdfs[0], context.bsdf_ctx
        samples = sampler.next_1d(), sampler.next_2d()
        bs, weight = bsdf.sample(bsdf_ctx, si, *samples, active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth = active & ~delta & specular.on_its_side(si, bs)
        with context.resume_grad():
            f, pdf = bsdf.eval_pdf(bsdf_ctx, si, bs.wo, smooth)
            previous = [
                bsdfₚ.eval(bsdf_ctx, siₚ, bs.wo, smooth) for bsdfₚ, siₚ in zip(bsdfs[1:], materials[1:], strict=True)
            ]
            if lobe is not None:
                f = lobe.without(f, bs.wo)
        values = [f, *previous]
        weights = specular.sampling_weights(values, pdf, weight, smooth, delta, bs.pdf)
        if self.changing_delta and (context.pair or not context.primal):
            lobes = specular.DeltaLobes(context.tables, bsdf, bs, samples, active, active & delta)
            lobes.follow(context, bsdfs, materials, values, weights)
        return BsdfDirection(bs, pdf, delta, values, weights)

    def _differentiate(
        self,
        context: PathContext,
        path: PathState,
        Le: Sequence[Spectrum],
        Ld: Sequence[Spectrum],
        values: Sequence[Spectrum],
    ) -> None:
        """Back-propagate the derivative of this vertex, or propagate tangents through it.

        `path.L` is the radiance that arrives from the sampled direction. Multiplied by f / detach(f), it has f's derivative.
        """
        with dr.resume_grad():
            Lo = [e + d + L * relative(value) for e, d, L, value in zip(Le, Ld, path.L, values, strict=True)]
            if context.forward:
                path.δL += mi.Spectrum(dr.forward_to(Lo[0]))
            else:
                flags = KEEP if path.branches else dr.ADFlag.Default
                dr.backward_from(context.adjoint_sum(Lo), flags=flags)

    def _record(
        self,
        record: ConnectionRecord,
        path: PathState,
        connection: emitters.EmitterConnection,
        parts: tuple[Spectrum, Spectrum, Spectrum],
    ) -> None:
        """Record the connection of this vertex, from its Le, Ld and value of the direction. The derivative of its contribution is that
        of Ld itself plus that of the throughput up to the vertex."""
        Le, Ld, value = parts
        with dr.resume_grad():
            # Le is not needed, but Dr.Jit requires that everything attached within an iteration is traversed in it.
            tangents: Any = dr.forward_to(Le, Ld, relative(value))
            _, δLd, δlogf = (mi.Spectrum(tangent) for tangent in tangents)
        Ld = dr.detach(Ld)
        record.write(path.depth, connection.emitter, Ld, δLd + Ld * path.δlogβ, connection.active)
        path.δlogβ += δlogf

    # ------------------------------------------------------------------ differential paths

    def _rough_lobe(
        self, context: PathContext, path: PathState, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: Bool
    ) -> RoughLobe | None:
        """Return the lobe of the path's first vertex with differential roughness sampling, and store that vertex; None in other passes."""
        if not path.branches or self.differential is None:
            return None
        (branch,) = path.branches
        lobe = self.differential.lobe(context, si, bsdf, active & ~branch.valid)
        path.branches = [branch.or_else(BranchVertex(path.ray, path.depth, path.β[0], path.η, lobe.served))]
        return lobe

    def _follow_branches(self, context: PathContext, path: PathState, sampler: Any) -> None:
        """Back-propagate the roughness derivatives that the replay has omitted, or propagate tangents."""
        (branch,) = path.branches
        numbers = independent(sampler, dr.width(branch.ray))
        dr.eval(branch, path.δL, numbers)  # Two backward passes in one kernel would race for the same gradients.
        differential: Any = self.differential
        contribution = differential.contribution(context, branch, numbers, self._incident(context))
        with dr.resume_grad():
            if context.forward:
                path.δL += mi.Spectrum(dr.forward_to(contribution))
            else:
                dr.backward_from(context.adjoint_sum([contribution]))

    def _incident(self, context: PathContext) -> Callable[..., Spectrum]:
        """Return the `incident` argument of `DifferentialBsdf.contribution`, which traces standard paths."""
        primal = PathContext(dr.ADMode.Primal, context.scene, context.tables, geometry=context.posed)

        def trace(branch: BranchVertex, vertex: ScatteringVertex, ray: Any, numbers: Any, active: Bool) -> Spectrum:
            path = self._begin(primal, ray)
            path.depth, path.η, path.active = branch.depth + 1, mi.Float(branch.η), mi.Bool(active)
            path.last = vertex
            path, _ = while_loop(**self._loop(primal, path, numbers))
            return path.L[0]

        return trace


class PrbKernel:
    """Mitsuba's `prb` as a `PathKernel`, for parameters that move geometry. Its adjoint is the continuous part of their derivative. It
    omits visibility, which `BoundaryIntegrator` adds for meshes."""

    def __init__(self, max_depth: int, rr_depth: int = 5):
        self._integrator: Any = mi.load_dict({"type": "prb", "max_depth": max_depth, "rr_depth": rr_depth})
        self._depths = max_depth, rr_depth

    def sample(
        self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f, active: Bool | bool = True
    ) -> tuple[Spectrum, None]:
        """Trace one path per lane, see `PathKernel.sample`. Raise `ValueError` for pairs and for `geometry`, which `prb` does not
        support."""
        if context.pair or context.posed is not None:
            raise ValueError("prb: expected one state and the scene's own geometry")
        δL, state_in = (context.replay[0].δL, context.replay[0].radiance) if context.replay else (None, None)
        radiance = self._integrator.sample(context.mode, context.scene, sampler, ray, δL, state_in, mi.Bool(active))[0]
        return radiance, None

    def vertices(self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f) -> Float:
        """Return the number of vertices per lane of paths with the same distribution, see `PathKernel.vertices`."""
        return PathPair(*self._depths).vertices(context, sampler, ray)
