"""Derivatives by a medium along a ray: points where in-scattering begins, and its own collisions. Symbols as in `tracking`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.base import Bool, Float, Spectrum, UInt32, largest, total
from unrender.rendering.mitsuba.integrators.majorant_supergrid import DdaState, HomogeneousMajorant, SupergridTraversal
from unrender.rendering.mitsuba.integrators.tracking import FAINT, MediumSegment, roulette, sample_optical_depth

_POINTS = 4.0
"""Minimum expected number of tentative points for the derivative on a segment, since an empty medium has no tentative collisions."""


@dataclass
class Reservoir:
    """A point of a path, sampled from all points where in-scattering may begin. It is state of Dr.Jit loops, hence mutable.

    Attributes:
        t: distance along the ray.
        depth: depth of the path before the point.
        β: throughput of each state to the point, times its MIS weight, over σ̄.
        total: total weight of all points offered.
    """

    ray: mi.Ray3f
    t: Float
    medium: mi.MediumPtr
    depth: UInt32
    β: list[Spectrum]
    weight: Float
    total: Float

    @staticmethod
    def empty(state_count: int) -> Reservoir:
        """Return a reservoir without points."""
        ray, medium = dr.zeros(mi.Ray3f), dr.zeros(mi.MediumPtr)
        β = [mi.Spectrum(0) for _ in range(state_count)]
        return Reservoir(ray, mi.Float(0), medium, mi.UInt32(0), β, mi.Float(0), mi.Float(0))

    def offer(
        self, segment: MediumSegment, t: Float, depth: UInt32, β: Sequence[Spectrum], weight: Float, sampler: Any
    ) -> None:
        """Replace the point by another with the probability of its weight, which is 0 for none."""
        self.total += weight
        take = (weight > 0) & (sampler.next_1d() * self.total < weight)
        self.ray = dr.select(take, segment.ray, self.ray)
        self.t = dr.select(take, t, self.t)
        self.medium = dr.select(take, segment.media[0], self.medium)
        self.depth = dr.select(take, depth, self.depth)
        self.β = [dr.select(take, new, old) for new, old in zip(β, self.β, strict=True)]
        self.weight = dr.select(take, weight, self.weight)

    @property
    def inverse_probability(self) -> Float:
        """Reciprocal of the probability of the sampled point; 0 without a point."""
        return dr.select(self.weight > 0, self.total / self.weight, 0)


@dataclass
class DifferentialRatioTracking:
    """Loop state of `update_reservoir`; β are throughputs up to this position, including ratio-tracked transmittance."""

    dda: DdaState
    β: list[Spectrum]
    reservoir: Reservoir
    active: Bool


@dr.syntax
def update_reservoir(
    reservoir: Reservoir, segment: MediumSegment, depth: UInt32, β: Sequence[Spectrum], sampler: Any, active: Bool
) -> Reservoir:
    """Sample points of a segment in proportion to transmittance only, by differential ratio tracking (Nimier-David et al. 2022).

    Tracking covers the full segment with a majorant. Each tentative point is offered to the reservoir with the ratio-tracked transmittance
    up to it, independent of the density at the point. Points are therefore sampled where the medium is empty, and none is weighted by 1/σₜ.
    An unbounded segment offers one point, of density c.
    """
    near, far = segment.near, segment.far
    active = active & (near < far)
    majorant = segment.majorant.at_least(dr.select(active, _POINTS / (far - near), 0))
    c = mis_density(segment, near)
    if segment.size > 0:
        _offer_unbounded(reservoir, segment, depth, β, sampler, active & ~dr.isfinite(far))
    walking = active & (c > 0) & dr.isfinite(far)
    walk = DifferentialRatioTracking(majorant.start(), [mi.Spectrum(b) for b in β], reservoir, walking)
    while dr.hint(walk.active, label="differential ratio tracking"):
        walk = _offer_point(segment, majorant, c, depth, walk, sampler)
    return walk.reservoir


def _offer_unbounded(
    reservoir: Reservoir, segment: MediumSegment, depth: UInt32, β: Sequence[Spectrum], sampler: Any, active: Bool
) -> None:
    """Offer one point of an unbounded segment, which is homogeneous. Its weight falls like the light of a lamp, so far points do not
    displace those of other segments."""
    u = sampler.next_1d()
    t = segment.near + segment.size * u / (1 - u)
    c, mei = mis_density(segment, t), segment.at(t)
    offered = []
    for b, medium in zip(β, segment.media, strict=True):
        σₛ, _, σₜ = medium.get_scattering_coefficients(mei, active)
        T = dr.exp(-σₜ * (t - segment.near))
        offered.append(b * T * mis_complement(σₜ if segment.by_extinction else σₛ, c) / c)
    weight = c * segment.size * total([dr.mean(b) for b in offered])
    reservoir.offer(segment, t, depth, offered, dr.select(active & (c > 0), weight, 0), sampler)


def _offer_point(
    segment: MediumSegment,
    majorant: HomogeneousMajorant | SupergridTraversal,
    c: Float,
    depth: UInt32,
    walk: DifferentialRatioTracking,
    sampler: Any,
) -> DifferentialRatioTracking:
    dda = majorant.advance(walk.dda, sample_optical_depth(sampler.next_1d()), walk.active)
    walking = walk.active & (dda.t < segment.far)
    t, σ̄ = dda.t, dda.σ̄
    mei = segment.at(t)
    coefficients = [medium.get_scattering_coefficients(mei, walking) for medium in segment.media]
    σ_of_states = [σₜ if segment.by_extinction else σₛ for σₛ, _, σₜ in coefficients]
    offered = [β * mis_complement(σ, c) / σ̄ for β, σ in zip(walk.β, σ_of_states, strict=True)]
    weight = dr.select(walking, total([dr.mean(β) for β in offered]), 0)
    reservoir = walk.reservoir
    reservoir.offer(segment, t, depth, offered, weight, sampler)
    walk.β = [β * dr.maximum(1 - σₜ / σ̄, 0) for β, (_, _, σₜ) in zip(walk.β, coefficients, strict=True)]
    most = largest(walk.β)
    # Russian roulette relative to the reservoir's total weight, since further points would rarely be sampled.
    survival = roulette(most * (segment.far - t) < FAINT * reservoir.total, sampler)
    walk.β = [β * survival for β in walk.β]
    walk.active = walking & ~(most <= 0) & (survival > 0)
    walk.dda = dda
    return walk


def relative_derivatives(segment: MediumSegment, t: Float, collides: Bool, noise: Any, inside: Bool) -> list[Spectrum]:
    """Return, for each state, the derivative of a path's contribution by the medium of a segment, relative to the contribution (attached;
    only the derivative is meaningful).

    `t` is where the segment ends, in lanes with a real collision (`collides`). The `noise` is independent of the path.
    """
    length = dr.select(collides, t, segment.far) - segment.near
    # Light leaves an unbounded medium only in channels without extinction. Its attenuation has an infinite derivative, left out here.
    length = dr.select(dr.isfinite(length), length, 0)
    collision, middle = segment.at(t), segment.at(segment.near + noise.next_1d() * length)
    c = mis_density(segment, t)
    result = []
    with dr.resume_grad():
        for medium in segment.media:
            depth = length * medium.get_scattering_coefficients(middle, inside)[2]
            σₛ, _, σₜ = medium.get_scattering_coefficients(collision, collides)
            either = dr.detach(σₛ) + c
            if segment.by_extinction:
                # The weight σₜ/(σₜ + c) over σₛ. Neither is 0 at a collision.
                either = dr.detach(σₛ) * (1 + c / dr.detach(σₜ))
            result.append(dr.select(collides & (either > 0), σₛ / either, 0) - depth)
    return result


def mis_density(segment: MediumSegment, t: Float) -> Float:
    """Return the density c of the second of the two estimators of the in-scattering derivative, approximately.

    A collision has the MIS weight σ/(σ + c), where σ is σₛ or σₜ, and a point of differential ratio tracking the complement. Any c is
    unbiased: here 1/(far - near), or s/(s + t - near)² on an unbounded segment, where s is its `size`.
    """
    near, far, s = segment.near, segment.far, segment.size
    unbounded = s / dr.square(s + t - near) if s > 0 else 0
    return dr.select(near < far, dr.select(dr.isfinite(far), dr.rcp(far - near), unbounded), 0)


def distance_scale(scene: mi.Scene) -> float:
    """Return the size of a scene, the scale of distances to points of unbounded segments; 0 if lights at infinity shine on them.

    Points of unbounded segments add nothing finite there: the derivative of a channel without extinction is infinite.
    """
    if any(mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite) for emitter in scene.emitters()):
        return 0.0
    box = scene.bbox()
    return float(max(box.extents())) if box.valid() else 0.0


def mis_complement(σ: Spectrum, c: Float) -> Spectrum:
    """Return c/(σ + c), 0 where both are 0."""
    return dr.select(c > 0, c / (σ + c), 0)
