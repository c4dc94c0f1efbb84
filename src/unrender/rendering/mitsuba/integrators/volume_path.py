"""What the volumetric path tracer knows of a path: where it begins, its loop state, a segment, a vertex, the direction it goes on in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum, UInt32
from unrender.rendering.mitsuba.integrators.base import PathContext, ScatteringVertex
from unrender.rendering.mitsuba.integrators.tracking import MediumSegment, Reservoir

__all__ = ["Flight", "PathStart", "SampledDirection", "Vertex", "VolumeContext", "VolumePathState"]


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
