"""Values of perfectly specular (delta) lobes with unknown parameters, which BSDF evaluation does not return."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum
from unrender.rendering.mitsuba.integrators.base import PathContext
from unrender.rendering.mitsuba.integrators.pointer_tables import registry_id

DELTA_EQUAL, DELTA_SIMPLE, DELTA_MASK = 0, 1, 2
"""Entries of `tables["delta"]`, by registry id of BSDFs: dependence of perfectly specular lobes on the BSDF's parameters. None; only by
their value (conductor, dielectric, plastic); by the opacity of a mask."""


class DeltaLobes:
    """Perfectly specular lobes that were sampled at one path vertex.

    Args:
        tables: its "delta" entry is used.
        bsdf: sampled BSDF of the current state.
        bs: the sampled directions.
        samples: the random numbers (1D, 2D) of the samples.
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
        """Return the value of the sampled lobe in one state; 1 for BSDFs whose specular lobes do not change.

        The value for a conductor, dielectric or plastic results from sampling that lobe alone, with probability one. That of a mask's
        null lobe is its null transmission. The derivative is that of the lobe. It does not include the probability of choosing the
        lobe, which the weight of an attached sample would add.
        """
        bs, value = self._bs, mi.Spectrum(1)
        for lobe in mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.Null:
            chosen = self._delta & (self._kind == DELTA_SIMPLE) & mi.has_flag(bs.sampled_type, lobe)
            ctx = mi.BSDFContext()
            ctx.type_mask = +lobe
            resampled, weight = bsdf.sample(ctx, si, *self._samples, chosen)
            value = dr.select(chosen, weight * dr.detach(resampled.pdf), value)
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
        """Replace the BSDF values of the specular lobes, and the previous state's weight, in place."""
        bs = self._bs
        for state in range(
            1 if context.primal else 0, context.state_count
        ):  # the current state's weight does not change
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
    """Return the sampling weight of each state for a direction that the current state sampled.

    It is the BSDF's total value over its total density, which both states share, or the sampled lobe's own weight if it is perfectly
    specular.

    Args:
        values: value of each state's BSDF (times cosine) or phase function, in the sampled direction.
        pdf: solid angle density of that direction.
        weight: weight of a perfectly specular lobe.
        smooth: lanes whose direction has a density.
        delta: lanes that sampled a perfectly specular lobe.
    """
    inv_pdf = dr.select(smooth & (pdf > 0), dr.rcp(pdf), 0)
    return [dr.select(delta, weight, dr.detach(value) * inv_pdf) for value in values]
