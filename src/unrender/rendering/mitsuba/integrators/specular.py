"""Sampled directions: their weights, those that a BSDF rejects, and the values of perfectly specular (delta) lobes, which no evaluation
returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.base import Bool, Float, PathContext, Spectrum, registry_id

_SAME_DENSITY = 1e-3  # relative difference up to which two densities of one direction are the same, for rounding
DELTA_EQUAL, DELTA_SIMPLE, DELTA_MASK = 0, 1, 2
"""Entries of `tables["delta"]`, by registry id of BSDFs: dependence of perfectly specular lobes on the BSDF's parameters. None; only by
their value (conductor, dielectric, plastic); by the opacity of a mask."""


class DeltaLobes:
    """Perfectly specular lobes that were sampled at one path vertex by random numbers (1D, 2D), in lanes `delta`; by `tables["delta"]`."""

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
        for state in range(int(context.primal), context.state_count):  # the current state's weight does not change
            with context.resume_grad():
                lobe = self._value(bsdfs[state], surfaces[state])
                values[state] = dr.select(self._delta, lobe, values[state])
            if state > 0:
                changed = self._delta & (self._kind != DELTA_EQUAL)
                inv_pdf = dr.select(bs.pdf > 0, dr.rcp(bs.pdf), 0)
                weights[state] = dr.select(changed, dr.detach(lobe) * inv_pdf, weights[state])


def on_its_side(si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f) -> Bool:
    """Return whether a sampled direction is on the side of the surface that its lobe has, reflection or transmission.

    A microfacet's reflection may point into the surface. Mitsuba rejects such a direction by a weight of 0, and no density counts it.
    Other lobes may still have a value there, which their own samples bring in.
    """
    same = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(bs.wo) > 0
    reflected, transmitted = (
        mi.has_flag(bs.sampled_type, kind) for kind in (mi.BSDFFlags.Reflection, mi.BSDFFlags.Transmission)
    )
    return dr.select(reflected & ~transmitted, same, True) & dr.select(transmitted & ~reflected, ~same, True)


def sampling_weights(
    values: Sequence[Spectrum], pdf: Float, weight: Spectrum, smooth: Bool, delta: Bool, own_pdf: Float
) -> list[Spectrum]:
    """Return the sampling weight of each state for a direction that the current state sampled.

    It is the BSDF's total value over its total density `pdf`, which both states share, or the sampled lobe's own `weight` if it is
    perfectly specular. Where that is 0, although value and density are not, and the BSDF gave the whole density (`own_pdf`), the direction
    was rejected, and its weight is 0 in all states.
    """
    full_density = dr.abs(own_pdf - pdf) <= _SAME_DENSITY * pdf
    rejected = full_density & (dr.max(weight) <= 0) & (dr.max(dr.detach(values[0])) > 0)
    inv_pdf = dr.select(smooth & ~rejected & (pdf > 0), dr.rcp(pdf), 0)
    return [dr.select(delta, weight, dr.detach(value) * inv_pdf) for value in values]
