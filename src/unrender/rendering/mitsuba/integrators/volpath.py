"""Volumetric path tracer for one state or two, and its adjoint: surfaces as in `path.py`, and participating media.

Symbols as there, and: T transmittance, σₜ extinction, σₛ scattering, σ̄ majorant. A vertex is a scattering event, on a surface or in a
medium. Index-matched boundaries are not vertices.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators import differential_tracking, emitters, specular, tracking
from unrender.rendering.mitsuba.integrators.base import (
    KEEP,
    Bool,
    Float,
    PathContext,
    ScatteringVertex,
    Spectrum,
    carries_light,
    largest,
    registry_id,
    relative,
    while_loop,
)
from unrender.rendering.mitsuba.integrators.differential_tracking import Reservoir
from unrender.rendering.mitsuba.integrators.tracking import MediumSegment
from unrender.rendering.mitsuba.integrators.volume_path import (
    ConnectionSample,
    Flight,
    PathStart,
    SampledDirection,
    Vertex,
    VolumeContext,
    VolumePathState,
    connect,
)
from unrender.rendering.mitsuba.samplers import independent


class VolumePair:
    """Volumetric path tracer.

    Args:
        max_depth: maximum path length in segments, as in Mitsuba's `volpath` (1: directly visible emitters only), >= 1.
        rr_depth: depth from which Russian roulette may terminate a path.
        changing_delta: as for `PathPair`.
        differentiate_media: whether parameters of media are unknown; otherwise their derivative is not estimated.
        emission: whether there are media that emit (`emissive.py`).
        radiance_field: whether all media emit, with radiance > 0 wherever there is extinction.

    Collisions, directions and Russian roulette depend on both states. The adjoint of a pair therefore needs both (`adjoint_pair`), even
    for one gradient.

    *The derivative of a medium.* Along a segment of length D, with L(t) arriving from beyond t and Lₛ(t) scattered into it,

        ∂L = ∫ T(t) (∂σₛ(t) Lₛ(t) - ∂σₜ(t) L(t)) dt + (contribution of the path's other vertices)

    For a path that contributes C, the second term is -C ∫ ∂σₜ over the part of the segment before the collision. One uniform point,
    independent of the collisions in C, estimates the integral. The first term has two estimators, the path's own collisions and, where
    σₛ is small, differential ratio tracking (`update_reservoir`), with the MIS weights σₛ/(σₛ + c) and c/(σₛ + c). Neither divides by
    σₛ, σₜ, or σ̄ - σₜ. Gradients are therefore unbiased where density or albedo is zero, and where the density equals the majorant. In
    a radiance field, where σₛ is the emission, the weights are σₜ/(σₜ + c) and c/(σₜ + c), so points are offered without evaluating its
    many coefficients.
    """

    def __init__(
        self,
        max_depth: int,
        rr_depth: int = 5,
        changing_delta: bool = False,
        differentiate_media: bool = True,
        emission: bool = False,
        radiance_field: bool = False,
    ):
        # This is not a dataclass, since Dr.Jit would treat a dataclass as state of the loop below.
        self.max_depth = max_depth
        self.rr_depth = rr_depth
        self.changing_delta = changing_delta
        self.differentiate_media = differentiate_media
        self.emission = emission
        self.radiance_field = radiance_field

    def sample(
        self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f, active: Bool | bool = True
    ) -> tuple[Spectrum, Spectrum | None]:
        """Trace one path per lane, see `PathKernel.sample`. `tables` also has the entries of `ScenePair.media()` and `.majorants()`.

        Raises `ValueError` for `geometry`, since posed shapes are not supported with media.
        """
        if context.posed is not None:
            raise ValueError("media: expected the scene's own geometry")
        volume = VolumeContext.of_camera(context, ray, active)
        noise = None if context.primal else independent(sampler, dr.width(ray))
        path, _, noise = while_loop(**self._loop(volume, self._begin(volume), sampler, noise))
        if context.primal:
            return path.L[0], path.L[1] if context.pair else None
        if self.differentiate_media:
            dr.eval(path.reservoir)  # Two backward passes in one kernel would race for the same gradients.
            path.δL += self._in_scattering(volume, path.reservoir, noise)
        return path.δL if context.forward else path.L[0], path.L[1] if context.pair else None

    def vertices(self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f) -> Float:
        """Return the number of vertices of each lane's path. Index-matched boundaries do not count."""
        volume = VolumeContext.of_camera(context, ray, True)
        path, *_ = while_loop(**self._loop(volume, self._begin(volume), sampler, None))
        return mi.Float(path.depth)

    def _begin(self, context: VolumeContext) -> VolumePathState:
        start, count = context.start, context.state_count
        return VolumePathState(
            ray=mi.Ray3f(start.ray),
            medium=mi.MediumPtr(start.medium),
            depth=mi.UInt32(start.depth),
            L=context.initial_radiance(),
            δL=mi.Spectrum(0),
            β=[mi.Spectrum(1) for _ in range(count)],
            η=mi.Float(1),
            last=ScatteringVertex(dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True)),
            reservoir=Reservoir.empty(count),
            forced=mi.Bool(start.t is not None),
            active=mi.Bool(start.active),
        )

    def _loop(self, context: VolumeContext, path: VolumePathState, sampler: Any, noise: Any) -> dict[str, Any]:
        """Return the arguments of the `dr.while_loop` over the segments from `context.start` on; it returns path, sampler and noise."""
        return {
            "state": (path, sampler, noise),
            "cond": lambda path, sampler, noise: path.active,
            "body": functools.partial(self._bounce, context),
            "label": f"volume pair ({context.mode.name})",
        }

    def _bounce(
        self, context: VolumeContext, path: VolumePathState, sampler: Any, noise: Any
    ) -> tuple[VolumePathState, Any, Any]:
        """Trace one segment and process the vertex at its end."""
        si = context.scene.ray_intersect(
            path.ray, ray_flags=mi.RayFlags.All, coherent=path.depth == 0, active=path.active
        )

        # ------------------------ Free flight ------------------------
        flight = self._fly(context, path, si, sampler, noise)
        scatters, escaped = flight.collides, path.active & ~flight.collides
        Lm = []
        if self.emission:
            # The throughput already includes the emission, which replaces the scattering coefficient. The path ends.
            Lm = [[dr.select(scatters & flight.emits, β, 0) for β in path.β]]
            scatters = scatters & ~flight.emits

        # ---------------------- Direct emission ----------------------
        surfaces, bsdfs = context.states.interactions(si), context.states.bsdfs(si.bsdf(path.ray))  # pyright: ignore[reportArgumentType]
        Le = emitters.direct_emission(context, path.last, surfaces, path.β, escaped)

        # ---------------------- Emitter sampling ----------------------
        vertex = Vertex(flight, surfaces, bsdfs, scatters & flight.may_scatter, escaped)
        Ld, connection = self._sample_emitter(context, path, vertex, sampler, noise)

        # ---------------- Detached sampling of a direction ----------------
        direction = self._sample_direction(context, vertex, sampler)

        # ---- Update loop variables based on current interaction -----
        path.L = context.accumulate(path.L, Le, Ld, *Lm)
        if not context.primal:
            self._differentiate(context, path, flight, connection, (Le, Ld, direction.values))
        moved = self._scatter_on(path, vertex, direction)

        # -------------------- Stopping criterion ---------------------
        most = largest(path.β)
        q = dr.clip(most * dr.square(path.η), 0.05, 0.95)
        roulette = moved & (path.depth >= self.rr_depth)
        rr_weight = dr.select(roulette, dr.rcp(q), 1)
        path.β = [β * rr_weight for β in path.β]
        continues = vertex.scatters | (vertex.meets & (vertex.may_scatter | direction.null))
        path.active = continues & carries_light(path.β) & (~roulette | (sampler.next_1d() < q))
        path.depth[moved] += 1
        return path, sampler, noise

    def _fly(
        self, context: VolumeContext, path: VolumePathState, si: mi.SurfaceInteraction3f, sampler: Any, noise: Any
    ) -> Flight:
        """Sample a collision on the next segment. The throughput is stored in `path`, points for the derivative in the reservoir."""
        start, tables, ray, medium = context.start, context.tables, path.ray, path.medium
        follow_media = self.differentiate_media and not context.primal
        media = context.states.media(medium)
        inside = path.active & (medium != None)  # noqa: E711 (a comparison per lane)
        near, far = tracking.clip_segment(medium, ray, si.t, inside)
        size = differential_tracking.distance_scale(context.scene)
        segment = MediumSegment(tables, media, ray, near, far, inside, self.radiance_field, size)
        may_scatter = path.active & (path.depth + 1 < self.max_depth)
        emits = mi.Bool(False)
        if self.emission:
            emits = dr.gather(mi.UInt32, tables["emits"], registry_id(medium), inside) != 0
        if follow_media:
            offers = inside & (may_scatter | emits)
            path.reservoir = differential_tracking.update_reservoir(
                path.reservoir, segment, path.depth, path.β, noise, offers
            )
        flies = inside & ~path.forced
        t, collides, path.β = tracking.sample_free_flight(segment, path.β, sampler, flies)
        if start.t is not None:
            t = dr.select(path.forced, start.t, t)
            collides |= path.forced
            path.forced &= False
        derivatives = ()
        if follow_media:
            changes = differential_tracking.relative_derivatives(segment, t, collides, noise, inside)
            with dr.resume_grad():
                # Without throughput, L is a rounding error that long segments enlarge.
                derivatives = [
                    dr.select(β > 0, L * change, 0) for β, L, change in zip(path.β, path.L, changes, strict=True)
                ]
        return Flight(segment, t, collides, emits, may_scatter, derivatives)

    def _sample_emitter(
        self, context: VolumeContext, path: VolumePathState, vertex: Vertex, sampler: Any, noise: Any
    ) -> tuple[list[Spectrum], ConnectionSample | None]:
        """Return Ld of each state, by next-event estimation, and a point of the connection if derivatives of media are needed."""
        si = vertex.si
        if not context.scene.emitters():  # no emitter to sample; keep the sequence of random numbers
            sampler.next_2d()
            return [mi.Spectrum(0) for _ in range(context.state_count)], None
        smooth = mi.has_flag(vertex.bsdfs[0].flags(), mi.BSDFFlags.Smooth)
        at_medium = vertex.scatters & path.medium.use_emitter_sampling()
        at_surface = vertex.meets & vertex.may_scatter & smooth
        sampled = emitters.EmitterConnection(context, vertex.interaction, sampler.next_2d(), at_medium | at_surface)
        ds = sampled.ds
        medium = dr.select(at_surface & si.is_medium_transition(), si.target_medium(ds.d), path.medium)
        noise = noise if self.differentiate_media else None
        T, sample = connect(context, vertex.interaction, ds.p, medium, sampler, noise, sampled.active)
        with context.resume_grad():
            values, pdf = vertex.evaluate(
                context, si.to_local(ds.d), ds.d, at_surface & sampled.active, at_medium & sampled.active
            )
            β = [throughput * passed for throughput, passed in zip(path.β, T, strict=True)]
            return sampled.contributions(β, values, pdf), sample if self.differentiate_media else None

    def _sample_direction(self, context: VolumeContext, vertex: Vertex, sampler: Any) -> SampledDirection:
        meets, scatters = vertex.meets, vertex.scatters
        samples = sampler.next_1d(), sampler.next_2d()
        bs, weight = vertex.bsdfs[0].sample(context.bsdf_ctx, vertex.si, *samples, meets)
        phase = vertex.media[0].phase_function()
        d, _, pdfₘ = phase.sample(context.phase_ctx, vertex.mei, *samples, scatters)
        delta = meets & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth = meets & ~delta & specular.on_its_side(vertex.si, bs)
        with context.resume_grad():
            values, pdf = vertex.evaluate(context, bs.wo, d, smooth, scatters)
        pdf = dr.select(scatters, pdfₘ, pdf)
        weights = specular.sampling_weights(values, pdf, weight, smooth | scatters, delta, bs.pdf)
        if self.changing_delta and (context.pair or not context.primal):
            lobes = specular.DeltaLobes(context.tables, vertex.bsdfs[0], bs, samples, meets, delta)
            lobes.follow(context, vertex.bsdfs, vertex.surfaces, values, weights)
        return SampledDirection(bs, d, pdf, delta, values, weights)

    def _differentiate(
        self,
        context: VolumeContext,
        path: VolumePathState,
        flight: Flight,
        connection: ConnectionSample | None,
        contributions: tuple[Sequence[Spectrum], ...],
    ) -> None:
        """Back-propagate the derivative of this segment and vertex, or propagate tangents through them.

        `contributions` are Le, Ld and the value in the sampled direction, which scatters `path.L`. Multiplied by f / detach(f), it has
        f's derivative.
        """
        Le, Ld, values = contributions
        with dr.resume_grad():
            Lo = [e + d + L * relative(value) for e, d, L, value in zip(Le, Ld, path.L, values, strict=True)]
            if self.differentiate_media:
                Lo = [m + rest for m, rest in zip(flight.derivatives, Lo, strict=True)]
            if connection is not None:
                depths = [connection.optical_depth(medium) for medium in context.states.media(connection.medium)]
                Lo = [rest - dr.detach(d) * τ for rest, d, τ in zip(Lo, Ld, depths, strict=True)]
            if context.forward:
                path.δL += dr.forward_to(Lo[0])
            else:
                dr.backward_from(context.adjoint_sum(Lo), flags=KEEP)

    def _scatter_on(self, path: VolumePathState, vertex: Vertex, direction: SampledDirection) -> Bool:
        """Continue in the sampled direction. Return the lanes that scattered, in the medium or at a boundary that is not index-matched."""
        si, bs, scatters, meets = vertex.si, direction.bs, vertex.scatters, vertex.meets
        connects = path.medium.use_emitter_sampling()
        moved = scatters | (meets & ~direction.null)
        path.η *= dr.select(meets, bs.eta, 1)
        path.β = [β * weight for β, weight in zip(path.β, direction.weights, strict=True)]
        scattered = mi.Interaction3f(vertex.mei).spawn_ray(direction.d)
        path.ray = dr.select(scatters, scattered, si.spawn_ray(si.to_world(bs.wo)))
        path.medium = dr.select(meets & si.is_medium_transition(), si.target_medium(path.ray.d), path.medium)
        last, delta = path.last, direction.delta
        path.last = ScatteringVertex(
            dr.select(moved, dr.detach(vertex.interaction), last.interaction),
            dr.select(moved, dr.select(delta, 1, direction.pdf), last.pdf),
            dr.select(moved, delta | (scatters & ~connects), last.delta),
        )
        return moved

    def _in_scattering(self, context: VolumeContext, point: Reservoir, noise: Any) -> Spectrum:
        """Back-propagate the derivative of the scattering at the sampled point, whose incident radiance a separate path estimates. In
        `Forward` mode return the derivative along the tangents, else 0."""
        active = point.total > 0
        start = PathStart(point.ray, point.medium, point.depth, active, point.t)
        primal = VolumeContext(start, dr.ADMode.Primal, context.scene, context.tables, pair=context.pair)
        path = self._begin(primal)
        if self.radiance_field:
            path.L = [mi.Spectrum(1) for _ in path.L]  # The coefficient below is the emission, so no path is needed.
        else:
            path, noise, _ = while_loop(**self._loop(primal, path, noise, None))
        inverse_probability = point.inverse_probability
        mei = tracking.medium_interaction(point.ray, point.t)
        with dr.resume_grad():
            Lo = [
                L * β * inverse_probability * medium.get_scattering_coefficients(mei, active)[0]
                for L, β, medium in zip(path.L, point.β, context.states.media(point.medium), strict=True)
            ]
            if context.forward:
                return dr.forward_to(Lo[0])
            dr.backward_from(context.adjoint_sum(Lo), flags=KEEP)
        return mi.Spectrum(0)
