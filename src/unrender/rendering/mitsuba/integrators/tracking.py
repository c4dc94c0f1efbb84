"""Sampling along a ray in a participating medium: free flight, transmittance, and points for the derivative of in-scattering.

Symbols: σ̄ majorant (one number per lane that bounds all channels of all states), σₜ extinction, σₛ scattering, β throughput, T
transmittance. Media, throughputs and transmittances are lists with one entry per state, the current state first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.base import Bool, Float, Spectrum, UInt32, largest, total
from unrender.rendering.mitsuba.integrators.majorant_supergrid import DdaState, HomogeneousMajorant, SupergridTraversal

_FAINT = 0.1
"""Transmittance below which Russian roulette may terminate tracking."""

_POINTS = 4.0
"""Minimum expected number of tentative points for the derivative on a segment, since an empty medium has no tentative collisions."""


def medium_interaction(ray: mi.Ray3f, t: Float) -> mi.MediumInteraction3f:
    """Return the medium interaction at distance `t` along a ray."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.t = t
    mei.p = ray(t)
    mei.wi = -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time = ray.time
    mei.wavelengths = ray.wavelengths
    return mei


def clip_segment(medium: mi.MediumPtr, ray: mi.Ray3f, reach: Float, active: Bool) -> tuple[Float, Float]:
    """Return the interval of a ray that ends at `reach` inside the bounding box of a medium; (0, 0) if it is outside."""
    hit, near, far = medium.intersect_aabb(ray)
    near, far = dr.maximum(near, 0), dr.minimum(far, reach)
    inside = active & hit & (near < far)
    return dr.select(inside, near, 0), dr.select(inside, far, 0)


class MediumSegment:
    """A ray segment inside a medium, with bounds of the extinction. This is not a dataclass, since Dr.Jit would treat a dataclass as
    loop state.

    Args:
        tables: majorants of `ScenePair.majorants()`; media without a supergrid there have their own majorant.
        media: `mi.MediumPtr` of each state.
        ray: ray through the medium.
        near, far: results of `clip_segment`.
        active: lanes inside the medium.
        by_extinction: whether the MIS weights of the in-scattering derivative use σₜ instead of σₛ. This is cheaper if σₛ is expensive
            to evaluate, and requires σₛ > 0 wherever σₜ > 0: as for the emission of a radiance field.

    Attributes:
        majorant: bound of all channels of all states from `near` to `far`.
    """

    def __init__(
        self,
        tables: Mapping[str, Any],
        media: Sequence[mi.MediumPtr],
        ray: mi.Ray3f,
        near: Float,
        far: Float,
        active: Bool,
        by_extinction: bool = False,
    ):
        self.media, self.ray, self.near, self.far = media, ray, near, far
        self.by_extinction = by_extinction
        self.majorant = self._majorant(tables, active)

    def _majorant(self, tables: Mapping[str, Any], active: Bool) -> HomogeneousMajorant | SupergridTraversal:
        supergrids = "majorants" in tables
        σ̄ = None
        if not (supergrids and tables["every"]):
            mei = medium_interaction(self.ray, mi.Float(0))
            σ̄ = largest([medium.get_majorant(mei, active) for medium in self.media])
            σ̄ = dr.select(active, dr.detach(σ̄), 0)
        if supergrids:
            return SupergridTraversal(tables, self.media[0], self.ray, self.near, self.far, σ̄, active)
        return HomogeneousMajorant(σ̄, self.near, self.far)

    def at(self, t: Float) -> mi.MediumInteraction3f:
        """Return the medium interaction at distance `t` along the ray."""
        return medium_interaction(self.ray, t)

    def extinctions(self, mei: mi.MediumInteraction3f, active: Bool) -> list[Spectrum]:
        """Return σₜ of each state."""
        return [medium.get_scattering_coefficients(mei, active)[2] for medium in self.media]


def sample_optical_depth(u: Float) -> Float:
    """Return the optical depth of the majorant to the next tentative collision, from a uniform number."""
    return -dr.log(1 - u)


# ------------------------------------------------------------------ free flight


@dataclass
class FreeFlight:
    """Loop state of `sample_free_flight`, and its result.

    Attributes:
        dda: position on the segment.
        β: throughput of each state.
        collides: whether the collision at `dda.t` is real.
        active: lanes without a real collision so far.
    """

    dda: DdaState
    β: list[Spectrum]
    collides: Bool
    active: Bool


@dr.syntax
def sample_free_flight(
    segment: MediumSegment, β: Sequence[Spectrum], sampler: Any, active: Bool
) -> tuple[Float, Bool, list[Spectrum]]:
    """Sample a collision on a segment: in closed form for homogeneous media, else by delta tracking.

    The probability of a real collision weights all channels of all states by their throughput. The sum of all throughputs is then
    constant, so none of them diverges.

    Returns:
        distance of the real collision, whether there is one, and the throughputs, including σₛ over the density.
    """
    flying = active & (segment.near < segment.far)
    closed = flying & segment.media[0].is_homogeneous()
    flight = FreeFlight(segment.majorant.start(), list(β), mi.Bool(False), flying & ~closed)
    _sample_exponential(segment, flight, sampler, closed)
    while dr.hint(flight.active, label="free flight"):
        flight = _tentative_collision(segment, flight, sampler)
    return flight.dda.t, flight.collides, _scattered(segment, flight)


def _sample_exponential(segment: MediumSegment, flight: FreeFlight, sampler: Any, active: Bool) -> None:
    """Complete flights through homogeneous media by the extinction of one channel of one state, sampled by throughput.

    Delta tracking has the same density. It does not end on an unbounded segment where the extinctions differ by orders of magnitude.
    """
    near, far = segment.near, segment.far
    σₜ = segment.extinctions(segment.at(near), active)
    before = total([dr.sum(β) for β in flight.β])
    rest, chosen = mi.Float(sampler.next_1d() * before), mi.Float(0)
    for b, σ in ((b, σ) for β, σs in zip(flight.β, σₜ, strict=True) for b, σ in zip(β, σs, strict=True)):
        chosen = dr.select((b > 0) & (rest >= 0), σ, chosen)
        rest -= b
    t = near + dr.select(chosen > 0, sample_optical_depth(sampler.next_1d()) / chosen, dr.inf)
    collides = active & (t < far)
    length = dr.select(collides, t, far) - near
    βT = [β * dr.select(σ > 0, dr.exp(-σ * length), 1) for β, σ in zip(flight.β, σₜ, strict=True)]
    after = total([dr.sum(β * dr.select(collides, σ, 1)) for β, σ in zip(βT, σₜ, strict=True)])
    scale = dr.select(after > 0, before / after, 0)
    flight.β = [dr.select(active, β * scale, old) for β, old in zip(βT, flight.β, strict=True)]
    flight.collides = collides
    flight.dda.t = dr.select(active, t, flight.dda.t)


def _scattered(segment: MediumSegment, flight: FreeFlight) -> list[Spectrum]:
    """Return the throughput of each state after the collision. σₛ is evaluated only here, since an albedo lookup is expensive."""
    mei, collides = segment.at(flight.dda.t), flight.collides
    σₛ = [medium.get_scattering_coefficients(mei, collides)[0] for medium in segment.media]
    return [β * dr.select(collides, σ, 1) for β, σ in zip(flight.β, σₛ, strict=True)]


def _tentative_collision(segment: MediumSegment, flight: FreeFlight, sampler: Any) -> FreeFlight:
    dda = segment.majorant.advance(flight.dda, sample_optical_depth(sampler.next_1d()), flight.active)
    flying = flight.active & (dda.t < segment.far)
    σ̄ = dda.σ̄
    σₜ = segment.extinctions(segment.at(dda.t), flying)
    mass = total([dr.sum(β * σ) for β, σ in zip(flight.β, σₜ, strict=True)])
    p = dr.clip(mass / (σ̄ * total([dr.sum(β) for β in flight.β])), 0, 1)
    flight.collides = flying & (sampler.next_1d() < p)
    scale = dr.rcp(dr.select(flight.collides, p, 1 - p) * σ̄)
    flight.β = [
        dr.select(flying, β * scale * dr.select(flight.collides, 1, dr.maximum(σ̄ - σ, 0)), β)
        for β, σ in zip(flight.β, σₜ, strict=True)
    ]
    flight.active = flying & ~flight.collides
    flight.dda = dda
    return flight


# ------------------------------------------------------------------ transmittance


@dataclass
class RatioTracking:
    """Loop state of `estimate_transmittance`.

    Attributes:
        dda: position on the segment.
        T: transmittance of each state up to this position.
        active: lanes that are still tracking.
    """

    dda: DdaState
    T: list[Spectrum]
    active: Bool


@dr.syntax
def estimate_transmittance(segment: MediumSegment, sampler: Any, active: Bool) -> list[Spectrum]:
    """Return the transmittance of a segment in each state: in closed form for homogeneous media, else by ratio tracking."""
    length = segment.far - segment.near
    active = active & (segment.near < segment.far)
    closed = active & segment.media[0].is_homogeneous()
    mei = segment.at(segment.near)
    T = [dr.select(closed, dr.exp(-σₜ * length), 1) for σₜ in segment.extinctions(mei, closed)]
    walk = RatioTracking(segment.majorant.start(), T, active & ~closed)
    while dr.hint(walk.active, label="ratio tracking"):
        walk = _ratio_tracking_step(segment, walk, sampler)
    return walk.T


def _ratio_tracking_step(segment: MediumSegment, walk: RatioTracking, sampler: Any) -> RatioTracking:
    dda = segment.majorant.advance(walk.dda, sample_optical_depth(sampler.next_1d()), walk.active)
    walking = walk.active & (dda.t < segment.far)
    σₜ = segment.extinctions(segment.at(dda.t), walking)
    walk.T = [dr.select(walking, T * dr.maximum(1 - σ / dda.σ̄, 0), T) for T, σ in zip(walk.T, σₜ, strict=True)]
    most = largest(walk.T)
    survival = _roulette(walking & (most < _FAINT), sampler)
    walk.T = [T * survival for T in walk.T]
    walk.active = walking & ~(most <= 0) & (survival > 0)
    walk.dda = dda
    return walk


def _roulette(faint: Bool, sampler: Any) -> Float:
    """Return the weight of Russian roulette: 1, or 2 or 0 for `faint` lanes."""
    return dr.select(faint, dr.select(sampler.next_1d() < 0.5, 2.0, 0.0), 1.0)


# ------------------------------------------------------------------ derivative of in-scattering


@dataclass
class Reservoir:
    """A point of a path, sampled from all points where in-scattering may begin. It is state of Dr.Jit loops, hence mutable.

    Attributes:
        ray: ray that the point lies on.
        t: distance along the ray.
        medium: medium at the point.
        depth: depth of the path before the point.
        β: throughput of each state to the point, times its MIS weight, over σ̄.
        weight: weight of the point.
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

    @property
    def inverse_probability(self) -> Float:
        """Reciprocal of the probability of the sampled point; 0 without a point."""
        return dr.select(self.weight > 0, self.total / self.weight, 0)


@dataclass
class DifferentialRatioTracking:
    """Loop state of `update_reservoir`.

    Attributes:
        dda: position on the segment.
        β: throughput of each state up to this position, including ratio-tracked transmittance.
        reservoir: reservoir of the path.
        active: lanes that are still tracking.
    """

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
    """
    near, far = segment.near, segment.far
    active = active & (near < far)
    majorant = segment.majorant.at_least(dr.select(active, _POINTS / (far - near), 0))
    c = mis_constant(near, far)
    walking = active & (c > 0)
    walk = DifferentialRatioTracking(majorant.start(), [mi.Spectrum(b) for b in β], reservoir, walking)
    while dr.hint(walk.active, label="differential ratio tracking"):
        walk = _offer_point(segment, majorant, c, depth, walk, sampler)
    return walk.reservoir


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
    reservoir.total += weight
    take = walking & (sampler.next_1d() * reservoir.total < weight)
    reservoir.ray = dr.select(take, segment.ray, reservoir.ray)
    reservoir.t = dr.select(take, t, reservoir.t)
    reservoir.medium = dr.select(take, segment.media[0], reservoir.medium)
    reservoir.depth = dr.select(take, depth, reservoir.depth)
    reservoir.β = [dr.select(take, new, old) for new, old in zip(offered, reservoir.β, strict=True)]
    reservoir.weight = dr.select(take, weight, reservoir.weight)

    walk.β = [β * dr.maximum(1 - σₜ / σ̄, 0) for β, (_, _, σₜ) in zip(walk.β, coefficients, strict=True)]
    most = largest(walk.β)
    # Russian roulette relative to the reservoir's total weight, since further points would rarely be sampled.
    survival = _roulette(most * (segment.far - t) < _FAINT * reservoir.total, sampler)
    walk.β = [β * survival for β in walk.β]
    walk.active = walking & ~(most <= 0) & (survival > 0)
    walk.dda = dda
    return walk


def relative_derivatives(segment: MediumSegment, t: Float, collides: Bool, noise: Any, inside: Bool) -> list[Spectrum]:
    """Return, for each state, the derivative of a path's contribution by the medium of a segment, relative to the contribution
    (attached; only the derivative is meaningful).

    Args:
        segment: segment inside the medium.
        t: distance where the segment ends, if it `collides`.
        collides: lanes with a real collision.
        noise: random numbers independent of those of the path.
        inside: lanes inside the medium.
    """
    length = dr.select(collides, t, segment.far) - segment.near
    # Light leaves an unbounded medium only in channels without extinction, whose derivative is infinite and left out.
    length = dr.select(dr.isfinite(length), length, 0)
    collision, middle = segment.at(t), segment.at(segment.near + noise.next_1d() * length)
    c = mis_constant(segment.near, segment.far)
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


def mis_constant(near: Float, far: Float) -> Float:
    """Return the constant c of the two estimators of the in-scattering derivative.

    A collision has the MIS weight σ/(σ + c), where σ is σₛ or σₜ, and a point of differential ratio tracking the complement. Any c is
    unbiased. The density of the latter is about 1/(far - near).
    """
    return dr.select(near < far, dr.rcp(far - near), 0)


def mis_complement(σ: Spectrum, c: Float) -> Spectrum:
    """Return c/(σ + c), 0 where both are 0."""
    return dr.select(c > 0, c / (σ + c), 0)
