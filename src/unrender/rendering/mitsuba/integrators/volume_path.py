"""What the volumetric path tracer knows of a path: where it begins, its loop state, a segment, a vertex, the direction it goes on in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators import tracking
from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum, UInt32
from unrender.rendering.mitsuba.integrators.base import PathContext, ScatteringVertex, carries_light
from unrender.rendering.mitsuba.integrators.tracking import MediumSegment, Reservoir


class PathStart:
    """Where paths begin: on rays, or in a medium at distance `t` along rays, where they scatter first.

    Attributes:
        ray: `mi.Ray3f`.
        medium: at its origin.
        depth: of what lies before.
        active: which lanes have one.
        t: None, or where to scatter.
    """

    def __init__(self, ray: mi.Ray3f, medium: mi.MediumPtr, depth: UInt32, active: Bool, t: Float | None = None):
        self.ray, self.medium, self.depth, self.active, self.t = ray, medium, depth, active, t


@dataclass
class VolumePathState:
    """A path's loop state.

    Attributes:
        ray: of the next segment.
        medium: that it lies in.
        depth: vertices so far.
        L: radiance of each state: gathered so far or, in a replay, still to be gathered.
        δL: derivative of the radiance along the tangents (forward mode).
        β: throughput of each state.
        η: relative index of refraction.
        last: the vertex that the path left last.
        reservoir: what differential ratio tracking keeps of the path.
        forced: lanes whose first collision is `PathStart.t`.
        active: lanes whose path goes on.
    """

    ray: mi.Ray3f
    medium: mi.MediumPtr
    depth: UInt32
    L: list[Spectrum]
    δL: Spectrum
    β: list[Spectrum]
    η: Float
    last: ScatteringVertex
    reservoir: Reservoir
    forced: Bool
    active: Bool


class VolumeContext(PathContext):
    """A `PathContext` that knows where its paths begin."""

    def __init__(self, start: PathStart, *others: Any):
        super().__init__(*others)
        self.start = start


class Flight:
    """A segment and what happens on it.

    Attributes:
        segment: the part inside a medium.
        t: distance of the collision.
        collides: lanes that collide in the medium.
        emits: lanes whose medium emits, and scatters nothing.
        may_scatter: lanes that depth lets scatter once more.
        derivatives: of each state, the derivative of L by the medium (attached); () where it is not looked for.
    """

    def __init__(
        self,
        segment: MediumSegment,
        t: Float,
        collides: Bool,
        emits: Bool,
        may_scatter: Bool,
        derivatives: Sequence[Spectrum],
    ):
        self.segment, self.t, self.collides, self.emits = segment, t, collides, emits
        self.may_scatter, self.derivatives = may_scatter, derivatives


class Vertex:
    """Where a segment ends, in a medium or on a surface.

    Attributes:
        mei, si: the interaction, as that of a medium and of a surface.
        interaction: the one of the two that it is.
        media, surfaces, bsdfs: the segment's medium, the surface interaction and the BSDF, of each state.
        scatters: lanes that scatter in the medium.
        meets: lanes that meet a surface and may go on.
        may_scatter: lanes that depth lets scatter once more.
    """

    def __init__(
        self,
        flight: Flight,
        surfaces: list[mi.SurfaceInteraction3f],
        bsdfs: list[mi.BSDFPtr],
        scatters: Bool,
        escaped: Bool,
    ):
        self.si, self.mei = surfaces[0], flight.segment.at(flight.t)
        self.media, self.surfaces, self.bsdfs = flight.segment.media, surfaces, bsdfs
        self.scatters, self.may_scatter = scatters, flight.may_scatter
        # At the last depth a boundary can still let light straight on.
        null = mi.has_flag(bsdfs[0].flags(), mi.BSDFFlags.Null)
        self.meets = escaped & self.si.is_valid() & (flight.may_scatter | null)
        self.interaction = dr.select(scatters, mi.Interaction3f(self.mei), mi.Interaction3f(self.si))

    def evaluate(
        self, context: PathContext, wo: mi.Vector3f, d: mi.Vector3f, at_surface: Bool, at_medium: Bool
    ) -> tuple[list[Spectrum], Float]:
        """Values of each state, and the current state's density: of the BSDF towards `wo` (local), of the phase function towards `d`."""
        f, pdf = self.bsdfs[0].eval_pdf(context.bsdf_ctx, self.si, wo, at_surface)
        fₘ, pdfₘ = self.media[0].phase_function().eval_pdf(context.phase_ctx, self.mei, d, at_medium)
        values = [dr.select(at_medium, fₘ, f)]
        for bsdf, si, medium in zip(self.bsdfs[1:], self.surfaces[1:], self.media[1:], strict=True):
            f = bsdf.eval(context.bsdf_ctx, si, wo, at_surface)
            fₘ, _ = medium.phase_function().eval_pdf(context.phase_ctx, self.mei, d, at_medium)
            values.append(dr.select(at_medium, fₘ, f))
        return values, dr.select(at_medium, pdfₘ, pdf)


class SampledDirection:
    """The direction in which a path goes on.

    Attributes:
        bs: `mi.BSDFSample3f`, on surfaces.
        d: in media, to the world.
        pdf: solid angle density.
        delta: lanes that sampled a perfectly specular lobe.
        null: of these, lanes that go straight on.
        values: of each state, of the BSDF, specular lobe or phase function; attached.
        weights: of each state, sampling weights; detached.
    """

    def __init__(
        self,
        bs: mi.BSDFSample3f,
        d: mi.Vector3f,
        pdf: Float,
        delta: Bool,
        values: list[Spectrum],
        weights: list[Spectrum],
    ):
        self.bs, self.d, self.pdf, self.delta, self.values, self.weights = bs, d, pdf, delta, values, weights
        self.null = delta & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)


@dataclass
class ConnectionSample:
    """One point of a connection, uniform over its length inside media. State of a Dr.Jit loop, hence mutable.

    Attributes:
        ray: it lies at `t` along this one.
        t: distance.
        medium: where it lies; null where the connection meets no medium.
        length: of the connection inside media.
    """

    ray: mi.Ray3f
    t: Float
    medium: mi.MediumPtr
    length: Float

    @staticmethod
    def empty() -> ConnectionSample:
        """Before any medium."""
        return ConnectionSample(dr.zeros(mi.Ray3f), mi.Float(0), dr.zeros(mi.MediumPtr), mi.Float(0))

    def update(self, segment: MediumSegment, noise: Any) -> None:
        """Extend the connection by a segment, inside whose medium the point may lie."""
        length = segment.far - segment.near
        self.length += length
        take = noise.next_1d() * self.length < length
        self.ray = dr.select(take, segment.ray, self.ray)
        self.medium = dr.select(take, segment.media[0], self.medium)
        self.t = dr.select(take, segment.near + noise.next_1d() * length, self.t)

    def optical_depth(self, medium: mi.MediumPtr) -> Spectrum:
        """The optical depth that this point stands for, in `medium`. Its derivative is that of -log T, unbiased."""
        mei = tracking.medium_interaction(self.ray, self.t)
        return self.length * medium.get_scattering_coefficients(mei, self.length > 0)[2]


@dataclass
class Connection:
    """Loop state of `connect`, and its result.

    Attributes:
        ray: of the next segment.
        medium: that it lies in.
        T: transmittance of each state so far.
        sample: see `connect`.
        active: lanes still on their way.
    """

    ray: mi.Ray3f
    medium: mi.MediumPtr
    T: list[Spectrum]
    sample: ConnectionSample
    active: Bool


@dr.syntax
def connect(
    context: PathContext,
    vertex: mi.Interaction3f,
    target: mi.Point3f,
    medium: mi.MediumPtr,
    sampler: Any,
    noise: Any,
    active: Bool,
) -> tuple[list[Spectrum], ConnectionSample]:
    """Transmittance of each state from `vertex`, which light leaves into `medium`, to `target`.

    With `noise`, random numbers of its own, also a point of the connection.
    """
    ray = vertex.spawn_ray_to(target)
    T = [mi.Spectrum(1) for _ in range(context.state_count)]
    way = Connection(ray, mi.MediumPtr(medium), T, ConnectionSample.empty(), mi.Bool(active))
    while dr.hint(way.active, label="emitter connection"):
        way = _connection_segment(context, target, way, sampler, noise)
    return way.T, way.sample


def _connection_segment(
    context: PathContext, target: mi.Point3f, way: Connection, sampler: Any, noise: Any
) -> Connection:
    ray, medium, active = way.ray, way.medium, way.active
    scene: Any = context.scene
    si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=False, active=active)
    inside = active & (medium != None)  # noqa: E711 (a comparison per lane)
    near, far = tracking.clip_segment(medium, ray, dr.minimum(si.t, ray.maxt), inside)
    segment = MediumSegment(context.tables, context.states.media(medium), ray, near, far, inside)
    passed = tracking.estimate_transmittance(segment, sampler, inside)
    if noise is not None:
        way.sample.update(segment, noise)

    hit = active & si.is_valid()
    surfaces, bsdfs = context.states.interactions(si), context.states.bsdfs(si.bsdf())
    way.T = [
        T * (dr.select(active, through, 1) * dr.select(hit, bsdf.eval_null_transmission(surface, hit), 1))
        for T, through, bsdf, surface in zip(way.T, passed, bsdfs, surfaces, strict=True)
    ]
    way.active = hit & carries_light(way.T)
    way.medium = dr.select(way.active & si.is_medium_transition(), si.target_medium(ray.d), medium)
    way.ray = dr.select(way.active, si.spawn_ray_to(target), ray)
    return way
