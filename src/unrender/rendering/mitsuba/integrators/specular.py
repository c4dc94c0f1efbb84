"""Perfectly specular (delta) lobes whose parameters are recovered: their values, which no BSDF evaluation returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum
from unrender.rendering.mitsuba.integrators.base import PathContext
from unrender.rendering.mitsuba.integrators.pointer_tables import registry_id

DELTA_EQUAL, DELTA_SIMPLE, DELTA_MASK = 0, 1, 2
"""Entries of `tables["delta"]`, by registry id of BSDFs: how perfectly specular lobes follow a change of the BSDF's parameters. Not at
all; by their value alone (conductor, dielectric, plastic); by the opacity of a mask."""


class DeltaLobes:
    """The perfectly specular lobes that were sampled at one path vertex.

    Args:
        tables: its "delta" entry is read.
        bsdf: of the current state, which was sampled.
        bs: the sampled directions.
        samples: the random numbers (1D, 2D) that these were sampled with.
        active: lanes where `bsdf` was sampled.
        delta: lanes where it sampled a perfectly specular lobe.
    """

    def __init__(
        self,
        tables: Mapping[str, Any],
        bsdf: mi.BSDFPtr,
        bs: mi.BSDFSample3f,
        samples: tuple[Float, mi.Point2f],
        active: Bool,
        delta: Bool,
    ):
        self._kind = dr.gather(mi.UInt32, tables["delta"], registry_id(bsdf), active)
        self._bs, self._samples, self._delta = bs, samples, delta

    def _value(self, bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f) -> Spectrum:
        """The value of the sampled lobe in one state; 1 for BSDFs whose specular lobes do not change.

        A conductor's, dielectric's or plastic's is had by sampling that lobe alone, with probability one; a mask's null lobe from
        its null transmission. The derivative is that of the lobe, not of the probability of choosing it, which the weight of an attached
        sample would add.
        """
        bs, value = self._bs, mi.Spectrum(1)
        for lobe in mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.Null:
            chosen = self._delta & (self._kind == DELTA_SIMPLE) & mi.has_flag(bs.sampled_type, lobe)
            ctx = mi.BSDFContext()
            ctx.type_mask = +lobe
            again, weight = bsdf.sample(ctx, si, *self._samples, chosen)
            value = dr.select(chosen, weight * dr.detach(again.pdf), value)
        chosen = self._delta & (self._kind == DELTA_MASK) & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        return dr.select(chosen, bsdf.eval_null_transmission(si, chosen), value)

    def follow(
        self,
        context: PathContext,
        bsdfs: Sequence[mi.BSDFPtr],
        surfaces: Sequence[mi.SurfaceInteraction3f],
        values: list[Spectrum],
        weights: list[Spectrum],
    ) -> None:
        """Put the lobes' values in the place of what BSDF evaluations gave for them, and those of the previous state into its weight."""
        bs = self._bs
        for state in range(1 if context.primal else 0, context.state_count):  # the current state's weight is its own
            with context.resume_grad():
                lobe = self._value(bsdfs[state], surfaces[state])
                values[state] = dr.select(self._delta, lobe, values[state])
            if state > 0:
                changed = self._delta & (self._kind != DELTA_EQUAL)
                inv_pdf = dr.select(bs.pdf > 0, dr.rcp(bs.pdf), 0)
                weights[state] = dr.select(changed, dr.detach(lobe) * inv_pdf, weights[state])


def sampling_weights(
    values: Sequence[Spectrum],
    pdf: Float,
    weight: Spectrum,
    smooth: Bool,
    delta: Bool,
) -> list[Spectrum]:
    """Sampling weight of each state for a direction that the current state sampled: the BSDF's whole value over its whole density,
    which both states share; the sampled lobe's own weight where it is perfectly specular.

    Args:
        values: of the BSDF (times cosine) or phase function of each state, in the sampled direction.
        pdf: solid angle density of that direction.
        weight: of a perfectly specular lobe.
        smooth: lanes whose direction has a density.
        delta: lanes that sampled a perfectly specular lobe.
    """
    inv_pdf = dr.select(smooth & (pdf > 0), dr.rcp(pdf), 0)
    return [dr.select(delta, weight, dr.detach(value) * inv_pdf) for value in values]
