"""The volumetric path tracer: surfaces as in `path.py`, and participating media, for one state or two, and its adjoint.

Symbols as there, and: T transmittance, σₜ extinction, σₛ scattering, σ̄ majorant. A vertex is where a path scatters, on a surface or
in a medium; boundaries that let light pass straight on are no vertices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.film import independent
from unrender.rendering.mitsuba.integrators import emitters, specular, tracking
from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum
from unrender.rendering.mitsuba.integrators.base import (
    KEEP,
    ReplayState,
    ScatteringVertex,
    carries_light,
    largest,
    relative,
)
from unrender.rendering.mitsuba.integrators.pointer_tables import registry_id
from unrender.rendering.mitsuba.integrators.tracking import MediumSegment, Reservoir
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


class VolumePair:
    """Settings of the volumetric path tracer.

    Args:
        max_depth: the longest path in segments, as in Mitsuba's `volpath` (1: directly visible emitters only), >= 1.
        rr_depth: the depth from which roulette may end a path.
        changing_delta: as for `PathPair`.
        differentiate_media: whether parameters of media are to be recovered: only then is their derivative looked for.
        emission: whether there are media that emit (`emissive.py`).
        radiance_field: whether all media do, with a radiance above 0 wherever there is extinction.

    Collisions, directions and roulette depend on both states, so the adjoint of a pair needs both (`adjoint_pair`), also where only
    one gradient is wanted.

    *The derivative of a medium.* Along a segment of length D, with L(t) arriving from beyond t and Lₛ(t) scattered into it,

        ∂L = ∫ T(t) (∂σₛ(t) Lₛ(t) - ∂σₜ(t) L(t)) dt + (what the path's other vertices give)

    The second term is -C ∫ ∂σₜ over the part of the segment that was flown, for a path that contributes C: the integral is estimated by one
    point, uniform and independent of the collisions that C is made of. The first is found twice, at the path's
    own collisions and, where σₛ is small, by differential ratio tracking (`update_reservoir`), weighted by σₛ/(σₛ + c) and c/(σₛ + c):
    neither divides by σₛ or σₜ, nor by σ̄ - σₜ. So gradients are unbiased wherever density or albedo is zero, and where
    density is at the majorant. In a radiance field, where σₛ stands for what is emitted, the weights are σₜ/(σₜ + c) and c/(σₜ + c): so
    points are offered without looking up its many coefficients.
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
        # No dataclass: Dr.Jit would take it for state of the loop below.
        self.max_depth = max_depth
        self.rr_depth = rr_depth
        self.changing_delta = changing_delta
        self.differentiate_media = differentiate_media
        self.emission = emission
        self.radiance_field = radiance_field

    def sample(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        tables: Mapping[str, Any],
        sampler: Any,
        ray: mi.RayDifferential3f,
        replay: tuple[ReplayState, ...] = (),
        pair: bool = False,
        geometry: Any = None,
        active: Bool | bool = True,
    ) -> tuple[Spectrum, Spectrum | None]:
        """Trace one path per lane. See `PathKernel.sample`; `tables` has also the entries of `ScenePair.media()` and `.majorants()`.

        Raises `ValueError` for other geometry than the scene's: posed shapes and media do not meet.
        """
        if geometry is not None:
            raise ValueError("media: expected the scene's own geometry")
        camera_medium: Any = dr.reinterpret_array(mi.MediumPtr, tables["camera"])
        start = PathStart(mi.Ray3f(dr.detach(ray)), camera_medium, mi.UInt32(0), mi.Bool(active))
        context = VolumeContext(start, mode, scene, tables, replay, pair)
        noise = None if context.primal else independent(sampler, dr.width(ray))
        path = self._trace(context, self._begin(context), sampler, noise)
        if context.primal:
            return path.L[0], path.L[1] if pair else None
        if self.differentiate_media:
            dr.eval(path.reservoir)  # Two backward passes in one kernel would race for the same gradients.
            path.δL += self._in_scattering(context, path.reservoir, noise)
        return path.δL if context.forward else path.L[0], path.L[1] if pair else None

    def vertices(
        self,
        scene: mi.Scene,
        tables: Mapping[str, Any],
        sampler: Any,
        ray: mi.RayDifferential3f,
        geometry: Any = None,
    ) -> Float:
        """See `PathKernel.vertices`. Borders that let light pass unchanged do not count."""
        del geometry
        camera_medium: Any = dr.reinterpret_array(mi.MediumPtr, tables["camera"])
        start = PathStart(mi.Ray3f(dr.detach(ray)), camera_medium, mi.UInt32(0), mi.Bool(True))
        context = VolumeContext(start, dr.ADMode.Primal, scene, tables, (), False)
        return mi.Float(self._trace(context, self._begin(context), sampler, None).depth)

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

    @dr.syntax
    def _trace(self, context: VolumeContext, path: VolumePathState, sampler: Any, noise: Any) -> VolumePathState:
        """Paths from `context.start` on, or their replay."""
        label = f"volume pair ({context.mode.name})"
        while dr.hint(path.active, label=label):
            path = self._bounce(context, path, sampler, noise)
        return path

    def _bounce(self, context: VolumeContext, path: VolumePathState, sampler: Any, noise: Any) -> VolumePathState:
        """One segment and the vertex at its end."""
        si = context.scene.ray_intersect(
            path.ray, ray_flags=mi.RayFlags.All, coherent=path.depth == 0, active=path.active
        )

        # ------------------------ Free flight ------------------------
        flight = self._fly(context, path, si, sampler, noise)
        scatters, escaped = flight.collides, path.active & ~flight.collides
        Lm = []
        if self.emission:
            # What a medium emits takes the place of what it scatters: it is in the throughput already. The path ends.
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
        goes_on = vertex.scatters | (vertex.meets & (vertex.may_scatter | direction.null))
        path.active = goes_on & carries_light(path.β) & (~roulette | (sampler.next_1d() < q))
        path.depth[moved] += 1
        return path

    def _fly(
        self, context: VolumeContext, path: VolumePathState, si: mi.SurfaceInteraction3f, sampler: Any, noise: Any
    ) -> Flight:
        """Sample a collision on the next segment; its throughput goes to `path`, its candidates for derivatives to the reservoir."""
        start, tables, ray, medium = context.start, context.tables, path.ray, path.medium
        follow_media = self.differentiate_media and not context.primal
        media = context.states.media(medium)
        inside = path.active & (medium != None)  # noqa: E711 (a comparison per lane)
        near, far = tracking.clip_segment(medium, ray, si.t, inside)
        segment = MediumSegment(tables, media, ray, near, far, inside, self.radiance_field)
        may_scatter = path.active & (path.depth + 1 < self.max_depth)
        emits = mi.Bool(False)
        if self.emission:
            emits = dr.gather(mi.UInt32, tables["emits"], registry_id(medium), inside) != 0
        if follow_media:
            offers = inside & (may_scatter | emits)
            path.reservoir = tracking.update_reservoir(path.reservoir, segment, path.depth, path.β, noise, offers)
        flies = inside & ~path.forced
        t, collides, path.β = tracking.sample_free_flight(segment, path.β, sampler, flies)
        if start.t is not None:
            t = dr.select(path.forced, start.t, t)
            collides |= path.forced
            path.forced &= False
        derivatives = ()
        if follow_media:
            changes = tracking.relative_derivatives(segment, t, collides, noise, inside)
            with dr.resume_grad():
                derivatives = [L * change for L, change in zip(path.L, changes, strict=True)]
        return Flight(segment, t, collides, emits, may_scatter, derivatives)

    def _sample_emitter(
        self, context: VolumeContext, path: VolumePathState, vertex: Vertex, sampler: Any, noise: Any
    ) -> tuple[list[Spectrum], ConnectionSample | None]:
        """Ld of each state, by next-event estimation, and a point of the connection, where derivatives of media are looked for."""
        si = vertex.si
        if not context.scene.emitters():  # nothing to connect to; paths have the same random numbers all the same
            sampler.next_2d()
            return [mi.Spectrum(0) for _ in range(context.state_count)], None
        smooth = mi.has_flag(vertex.bsdfs[0].flags(), mi.BSDFFlags.Smooth)
        at_medium = vertex.scatters & path.medium.use_emitter_sampling()
        at_surface = vertex.meets & vertex.may_scatter & smooth
        found = emitters.EmitterConnection(context, vertex.interaction, sampler.next_2d(), at_medium | at_surface)
        ds = found.ds
        medium = dr.select(at_surface & si.is_medium_transition(), si.target_medium(ds.d), path.medium)
        noise = noise if self.differentiate_media else None
        T, sample = connect(context, vertex.interaction, ds.p, medium, sampler, noise, found.active)
        with context.resume_grad():
            values, pdf = vertex.evaluate(
                context, si.to_local(ds.d), ds.d, at_surface & found.active, at_medium & found.active
            )
            β = [throughput * passed for throughput, passed in zip(path.β, T, strict=True)]
            return found.contributions(β, values, pdf), sample if self.differentiate_media else None

    def _sample_direction(self, context: VolumeContext, vertex: Vertex, sampler: Any) -> SampledDirection:
        meets, scatters = vertex.meets, vertex.scatters
        samples = sampler.next_1d(), sampler.next_2d()
        bs, weight = vertex.bsdfs[0].sample(context.bsdf_ctx, vertex.si, *samples, meets)
        phase = vertex.media[0].phase_function()
        d, _, pdfₘ = phase.sample(context.phase_ctx, vertex.mei, *samples, scatters)
        delta = meets & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth = meets & ~delta
        with context.resume_grad():
            values, pdf = vertex.evaluate(context, bs.wo, d, smooth, scatters)
        pdf = dr.select(scatters, pdfₘ, pdf)
        weights = specular.sampling_weights(values, pdf, weight, smooth | scatters, delta)
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
        """Back-propagate the derivative of this segment and vertex, or carry tangents forward through them.

        `contributions` are Le, Ld and the value in the sampled direction, through which `path.L` arrives: times f / detach(f) that carries
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
        """Leave the vertex in the sampled direction. Tells which lanes scattered, or met a boundary that turned them."""
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

    def _in_scattering(self, context: VolumeContext, kept: Reservoir, noise: Any) -> Spectrum:
        """Back-propagate the derivative of the scattering at the kept point, whose light is found by a path of its own; with `Forward`
        the derivative along the tangents is returned, else 0."""
        active = kept.total > 0
        start = PathStart(kept.ray, kept.medium, kept.depth, active, kept.t)
        primal = VolumeContext(start, dr.ADMode.Primal, context.scene, context.tables, (), context.pair)
        path = self._begin(primal)
        if self.radiance_field:
            path.L = [mi.Spectrum(1) for _ in path.L]  # No path: its radiance is what the coefficient below holds.
        else:
            path = self._trace(primal, path, noise, None)
        share = kept.inverse_probability
        mei = tracking.medium_interaction(kept.ray, kept.t)
        with dr.resume_grad():
            Lo = [
                L * β * share * medium.get_scattering_coefficients(mei, active)[0]
                for L, β, medium in zip(path.L, kept.β, context.states.media(kept.medium), strict=True)
            ]
            if context.forward:
                return dr.forward_to(Lo[0])
            dr.backward_from(context.adjoint_sum(Lo), flags=KEEP)
        return mi.Spectrum(0)
