"""Data types of the volumetric path tracer: start, loop state, segment, vertex, sampled direction and connection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators import tracking
from unrender.rendering.mitsuba.integrators.base import (
    Bool,
    Float,
    PathContext,
    ScatteringVertex,
    Spectrum,
    UInt32,
    carries_light,
)
from unrender.rendering.mitsuba.integrators.differential_tracking import Reservoir
from unrender.rendering.mitsuba.integrators.tracking import MediumSegment


class PathStart:
    """Start of paths: on rays, or at distance `t` along rays in a medium, where they scatter first."""

    def __init__(self, ray: mi.Ray3f, medium: mi.MediumPtr, depth: UInt32, active: Bool, t: Float | None = None):
        self.ray, self.medium, self.depth, self.active, self.t = ray, medium, depth, active, t


@dataclass
class VolumePathState:
    """Loop state of a path: ray and medium of the next segment, number of vertices so far, and last vertex.

    L is the radiance of each state: accumulated so far or, in a replay, remaining; δL its derivative along the tangents. In lanes `forced`,
    the first collision is `PathStart.t`.
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
    """A `PathContext` with the start of its paths."""

    def __init__(self, start: PathStart, *others: Any, pair: bool = False):
        super().__init__(*others, pair=pair)
        self.start = start

    @staticmethod
    def of_camera(context: PathContext, ray: mi.RayDifferential3f, active: Bool | bool) -> VolumeContext:
        """Return the context of paths that begin on camera rays, in the medium that the table "camera" has."""
        medium: Any = dr.reinterpret_array(mi.MediumPtr, context.tables["camera"])
        start = PathStart(mi.Ray3f(dr.detach(ray)), medium, mi.UInt32(0), mi.Bool(active))
        return VolumeContext(start, context.mode, context.scene, context.tables, context.replay, pair=context.pair)


class Flight:
    """A segment and its collision at `t`. In lanes `emits`, the medium emits and does not scatter. `derivatives` are of L by the medium,
    for each state (attached); () if not needed."""

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
    """End of a segment, in a medium or on a surface, as the valid `interaction` of the two. Lanes `scatters` scatter in the medium, lanes
    `meets` hit a surface and may continue."""

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
        # Paths of maximum depth may still pass through index-matched boundaries.
        null = mi.has_flag(bsdfs[0].flags(), mi.BSDFFlags.Null)
        self.meets = escaped & self.si.is_valid() & (flight.may_scatter | null)
        self.interaction = dr.select(scatters, mi.Interaction3f(self.mei), mi.Interaction3f(self.si))

    def evaluate(
        self, context: PathContext, wo: mi.Vector3f, d: mi.Vector3f, at_surface: Bool, at_medium: Bool
    ) -> tuple[list[Spectrum], Float]:
        """Return the values of each state, and the current state's density: of the BSDF towards `wo` (local), and of the phase function
        towards `d`."""
        f, pdf = self.bsdfs[0].eval_pdf(context.bsdf_ctx, self.si, wo, at_surface)
        fₘ, pdfₘ = self.media[0].phase_function().eval_pdf(context.phase_ctx, self.mei, d, at_medium)
        values = [dr.select(at_medium, fₘ, f)]
        for bsdf, si, medium in zip(self.bsdfs[1:], self.surfaces[1:], self.media[1:], strict=True):
            f = bsdf.eval(context.bsdf_ctx, si, wo, at_surface)
            fₘ, _ = medium.phase_function().eval_pdf(context.phase_ctx, self.mei, d, at_medium)
            values.append(dr.select(at_medium, fₘ, f))
        return values, dr.select(at_medium, pdfₘ, pdf)


class SampledDirection:
    """Direction in which a path continues: of a BSDF sample, or `d` in media; `null` are specular lanes that continue straight.

    For each state, `values` are of BSDF, specular lobe or phase function, attached; `weights` are detached.
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
    """A point of a connection, uniform over its `length` inside media; its medium is null if that is 0. It is state of a Dr.Jit loop, hence
    mutable."""

    ray: mi.Ray3f
    t: Float
    medium: mi.MediumPtr
    length: Float

    @staticmethod
    def empty() -> ConnectionSample:
        """Return the state before any medium."""
        return ConnectionSample(dr.zeros(mi.Ray3f), mi.Float(0), dr.zeros(mi.MediumPtr), mi.Float(0))

    def update(self, segment: MediumSegment, noise: Any) -> None:
        """Extend the connection by a segment inside a medium, which may contain the point."""
        length = segment.far - segment.near
        self.length += length
        take = noise.next_1d() * self.length < length
        self.ray = dr.select(take, segment.ray, self.ray)
        self.medium = dr.select(take, segment.media[0], self.medium)
        self.t = dr.select(take, segment.near + noise.next_1d() * length, self.t)

    def optical_depth(self, medium: mi.MediumPtr) -> Spectrum:
        """Return an estimate of the optical depth in `medium` from this point. Its derivative is that of -log T, unbiased."""
        mei = tracking.medium_interaction(self.ray, self.t)
        return self.length * medium.get_scattering_coefficients(mei, self.length > 0)[2]


@dataclass
class Connection:
    """Loop state of `connect`, and its result: ray and medium of the next segment, transmittance of each state so far, and the sampled
    point."""

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
    """Return the transmittance of each state from `vertex`, which light leaves into `medium`, to `target`.

    Also return a point of the connection, sampled with the independent random numbers `noise`; empty if `noise` is None.
    """
    ray = vertex.spawn_ray_to(target)
    T = [mi.Spectrum(1) for _ in range(context.state_count)]
    connection = Connection(ray, mi.MediumPtr(medium), T, ConnectionSample.empty(), mi.Bool(active))
    while dr.hint(connection.active, label="emitter connection"):
        connection = _connection_segment(context, target, connection, sampler, noise)
    return connection.T, connection.sample


def _connection_segment(
    context: PathContext, target: mi.Point3f, connection: Connection, sampler: Any, noise: Any
) -> Connection:
    ray, medium, active = connection.ray, connection.medium, connection.active
    scene: Any = context.scene
    si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=False, active=active)
    inside = active & (medium != None)  # noqa: E711 (a comparison per lane)
    near, far = tracking.clip_segment(medium, ray, dr.minimum(si.t, ray.maxt), inside)
    segment = MediumSegment(context.tables, context.states.media(medium), ray, near, far, inside)
    passed = tracking.estimate_transmittance(segment, sampler, inside)
    if noise is not None:
        connection.sample.update(segment, noise)

    hit = active & si.is_valid()
    surfaces, bsdfs = context.states.interactions(si), context.states.bsdfs(si.bsdf())
    connection.T = [
        T * (dr.select(active, through, 1) * dr.select(hit, bsdf.eval_null_transmission(surface, hit), 1))
        for T, through, bsdf, surface in zip(connection.T, passed, bsdfs, surfaces, strict=True)
    ]
    connection.active = hit & carries_light(connection.T)
    connection.medium = dr.select(connection.active & si.is_medium_transition(), si.target_medium(ray.d), medium)
    connection.ray = dr.select(connection.active, si.spawn_ray_to(target), ray)
    return connection
