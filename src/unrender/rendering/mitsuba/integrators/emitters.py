"""Emitters along a path: radiance that its segments meet and radiance that next-event estimation connects to, weighted by MIS.

The visibility (or transmittance) of an emitter is tested apart from its radiance, so that an emitter that is black in one state
still counts in the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum, UInt32
from unrender.rendering.mitsuba.integrators.base import PathContext, ScatteringVertex
from unrender.rendering.mitsuba.integrators.pointer_tables import registry_id

_LARGEST = 1e18
"""Solid angle density whose square, and twice that, is a finite single-precision number."""


def mis_weight(pdf_a: Float, pdf_b: Float) -> Float:
    """Return the weight of strategy a by the power heuristic with exponent 2, detached. Finite for all densities that are numbers.

    Densities count up to `_LARGEST` for both strategies, so the two weights still sum to one. A flat lamp seen edge-on has a density
    above 1e19, whose square is no single-precision number.
    """
    # Unlike a minimum, the selection passes on a density that is no number, so that its sample is dropped and counted.
    a, b = (dr.square(dr.select(pdf > _LARGEST, _LARGEST, pdf)) for pdf in (pdf_a, pdf_b))
    return dr.detach(dr.select(a == 0, 0, a / (a + b)))


def _sample_direction(context: PathContext, vertex: mi.Interaction3f, sample: mi.Point2f, active: Bool) -> Any:
    """A point on an emitter, its visibility not tested: with the scene's own probabilities or, where `tables` has some, with these."""
    if "emitter_cdf" not in context.tables:
        return context.scene.sample_emitter_direction(vertex, sample, False, active)[0]
    cdf, count = context.tables["emitter_cdf"], len(context.scene.emitters())
    index = dr.binary_search(0, count - 1, lambda i: dr.gather(mi.Float, cdf, i + 1, active) <= sample.x)
    first = dr.gather(mi.Float, cdf, index, active)
    pmf = dr.gather(mi.Float, cdf, index + 1, active) - first
    pointer = dr.gather(mi.UInt32, context.tables["emitter_ids"], index, active)
    emitter: Any = dr.reinterpret_array(mi.EmitterPtr, pointer)
    again = dr.clip((sample.x - first) / pmf, 0, dr.one_minus_epsilon(mi.Float))
    ds, _ = emitter.sample_direction(vertex, mi.Point2f(again, sample.y), active & (pmf > 0))
    ds.pdf *= pmf
    return ds


def _pdf_direction(context: PathContext, vertex: mi.Interaction3f, ds: mi.DirectionSample3f, active: Bool) -> Float:
    """The solid angle density with which `_sample_direction` finds a point on an emitter."""
    if "emitter_cdf" not in context.tables:
        return context.scene.pdf_emitter_direction(vertex, ds, active)
    emitter: Any = ds.emitter
    pmf = dr.gather(mi.Float, context.tables["emitter_pmf"], registry_id(emitter), active)
    return emitter.pdf_direction(vertex, ds, active) * pmf


def met_emitter(
    context: PathContext, last: ScatteringVertex, si: mi.SurfaceInteraction3f, active: Bool
) -> tuple[mi.EmitterPtr, Float]:
    """The emitter at a surface (or the environment) and the MIS weight of meeting it. Arguments: see `direct_emission`."""
    ds = mi.DirectionSample3f(context.scene, si=si, ref=last.interaction)
    return ds.emitter, mis_weight(last.pdf, _pdf_direction(context, last.interaction, ds, active & ~last.delta))


def direct_emission(
    context: PathContext,
    last: ScatteringVertex,
    surfaces: Sequence[mi.SurfaceInteraction3f],
    β: Sequence[Spectrum],
    active: Bool,
) -> list[Spectrum]:
    """Le of each state: what the emitter at a surface (or the environment) adds to a path that was sampled without looking for it.

    Args:
        last: where the path came from.
        surfaces: the interaction on the shape of each state.
        β: throughput of each state.
        active: lanes that meet a surface or leave the scene.
    """
    emitter, mis = met_emitter(context, last, surfaces[0], active)
    emitters = context.states.emitters(emitter)
    with context.resume_grad():
        return [
            throughput * mis * emitter.eval(surface, active)
            for throughput, emitter, surface in zip(β, emitters, surfaces, strict=True)
        ]


class EmitterConnection:
    """A point sampled on an emitter, to be connected with a vertex.

    Attributes:
        ds: `mi.DirectionSample3f`.
        active: lanes that found one; narrowed by the caller where the emitter is occluded.
    """

    def __init__(self, context: PathContext, vertex: mi.Interaction3f, sample: mi.Point2f, active: Bool):
        self._context, self._vertex = context, vertex
        self.ds = _sample_direction(context, vertex, sample, active)
        self.active = active & (self.ds.pdf > 0)  # false also where the density is not a number

    @property
    def emitter(self) -> UInt32:
        """The registry id of the emitter, 0 for none."""
        return registry_id(self.ds.emitter)

    def weight(self, pdf: Float) -> Float:
        """The MIS weight over the density. Arguments: see `contributions`."""
        mis = dr.select(self.ds.delta, 1, mis_weight(self.ds.pdf, pdf))
        return dr.select(self.active, mis * dr.rcp(self.ds.pdf), 0)

    def contributions(self, β: Sequence[Spectrum], values: Sequence[Spectrum], pdf: Float) -> list[Spectrum]:
        """Ld of each state: throughput, scattering, emitted radiance and MIS weight. Attached where the caller resumes gradients.

        Args:
            β: throughput of each state, transmittance included.
            values: of the BSDF (times cosine) or phase function, of each state, towards the emitter.
            pdf: solid angle density with which the current state's BSDF or phase function samples that direction.
        """
        ds = self.ds
        inv_pdf = dr.select(self.active, dr.rcp(ds.pdf), 0)
        mis = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
        found = []
        for throughput, value, emitter in zip(β, values, self._context.states.emitters(ds.emitter), strict=True):
            radiance = emitter.eval_direction(self._vertex, ds, self.active) * inv_pdf
            found.append(dr.select(self.active, throughput * mis * value * radiance, 0))
        return found
