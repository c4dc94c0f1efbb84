"""Steps through a participating medium: free flights, transmittance, and where the derivative of in-scattering is estimated.

Symbols: σ̄ majorant (one number per lane that bounds all channels of all states), σₜ extinction, σₛ scattering, β throughput,
T transmittance. Media, throughputs and transmittances are lists with one entry per state, the current state first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum, UInt32
from unrender.rendering.mitsuba.integrators.base import largest, total
from unrender.rendering.mitsuba.integrators.majorant_supergrid import (
    DdaState,
    HomogeneousMajorant,
    SupergridTraversal,
)

_FAINT = 0.1
"""Below this transmittance, roulette decides whether a walk through a medium goes on."""

_POINTS = 4.0
"""Tentative points on a segment, in the mean at least, where a derivative is looked for: an empty medium has none of its own."""


def medium_interaction(ray: mi.Ray3f, t: Float) -> mi.MediumInteraction3f:
    """The point of a medium at distance `t` along a ray."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.t = t
    mei.p = ray(t)
    mei.wi = -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time = ray.time
    mei.wavelengths = ray.wavelengths
    return mei


def clip_segment(medium: mi.MediumPtr, ray: mi.Ray3f, reach: Float, active: Bool) -> tuple[Float, Float]:
    """From where to where a ray that ends at `reach` is inside the bounding box of a medium; (0, 0) where it is not."""
    hit, near, far = medium.intersect_aabb(ray)
    near, far = dr.maximum(near, 0), dr.minimum(far, reach)
    inside = active & hit & (near < far)
    return dr.select(inside, near, 0), dr.select(inside, far, 0)


class MediumSegment:
    """A ray's way through a medium, and bounds of the extinction along it. No dataclass: Dr.Jit would take it for state of its loops.

    Args:
        tables: the majorants of `ScenePair.majorants()`; media without a supergrid there are bounded by their own majorant.
        media: `mi.MediumPtr` of each state.
        ray: through the medium.
        near, far: of `clip_segment`.
        active: lanes inside the medium.
        by_extinction: whether the two estimators of in-scattering's derivative are weighted by σₜ in place of σₛ, where that is dear to
            look up and nowhere 0 unless σₜ is: as the emission of a radiance field.

    Attributes:
        majorant: bounds all channels of all states from `near` to `far`.
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
        """The point at distance `t` along the ray."""
        return medium_interaction(self.ray, t)

    def extinctions(self, mei: mi.MediumInteraction3f, active: Bool) -> list[Spectrum]:
        """σₜ of each state."""
        return [medium.get_scattering_coefficients(mei, active)[2] for medium in self.media]


def sample_optical_depth(u: Float) -> Float:
    """The optical depth of majorants to the next tentative collision, from a uniform number."""
    return -dr.log(1 - u)


# ------------------------------------------------------------------ free flight


@dataclass
class FreeFlight:
    """Loop state of `sample_free_flight`, and its result.

    Attributes:
        dda: position on the segment.
        β: throughput of each state.
        collides: whether the collision at `dda.t` is real.
        active: lanes still flying.
    """

    dda: DdaState
    β: list[Spectrum]
    collides: Bool
    active: Bool


@dr.syntax
def sample_free_flight(
    segment: MediumSegment, β: Sequence[Spectrum], sampler: Any, active: Bool
) -> tuple[Float, Bool, list[Spectrum]]:
    """Delta tracking through a segment.

    A tentative collision is real with a probability that weighs all channels of all states by their throughput: the
    sum of all throughputs then stays as it is at every null collision, so none of them explodes.

    Returns:
        distance of the real collision, whether there is one, and the throughputs, σₛ over its density included.
    """
    flying = active & (segment.near < segment.far)
    flight = FreeFlight(segment.majorant.start(), list(β), mi.Bool(False), flying)
    while dr.hint(flight.active, label="free flight"):
        flight = _tentative_collision(segment, flight, sampler)
    return flight.dda.t, flight.collides, _scattered(segment, flight)


def _scattered(segment: MediumSegment, flight: FreeFlight) -> list[Spectrum]:
    """Throughput of each state behind the collision. Only here, since an albedo is dear to look up and null collisions need none."""
    mei, collides = segment.at(flight.dda.t), flight.collides
    σₛ = [medium.get_scattering_coefficients(mei, collides)[0] for medium in segment.media]
    return [β * dr.select(collides, σ, 1) for β, σ in zip(flight.β, σₛ, strict=True)]


def _tentative_collision(segment: MediumSegment, flight: FreeFlight, sampler: Any) -> FreeFlight:
    dda = segment.majorant.advance(flight.dda, sample_optical_depth(sampler.next_1d()), flight.active)
    flying = flight.active & (dda.t < segment.far)
    σ̄ = dda.σ̄
    σₜ = segment.extinctions(segment.at(dda.t), flying)
    share = total([dr.sum(β * σ) for β, σ in zip(flight.β, σₜ, strict=True)])
    p = dr.clip(share / (σ̄ * total([dr.sum(β) for β in flight.β])), 0, 1)
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
        T: transmittance of each state up to there.
        active: lanes still walking.
    """

    dda: DdaState
    T: list[Spectrum]
    active: Bool


@dr.syntax
def estimate_transmittance(segment: MediumSegment, sampler: Any, active: Bool) -> list[Spectrum]:
    """Transmittance of a segment in each state: in closed form where the medium is homogeneous, else by ratio tracking."""
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
    """The weight of a walk: 1; where it is `faint`, 2 or 0."""
    return dr.select(faint, dr.select(sampler.next_1d() < 0.5, 2.0, 0.0), 1.0)


# ------------------------------------------------------------------ derivative of in-scattering


@dataclass
class Reservoir:
    """One point of a path, kept of all those where in-scattering might begin. State of Dr.Jit loops, hence mutable.

    Attributes:
        ray: it lies at `t` along this one.
        t: distance.
        medium: where it lies.
        depth: of the path before it.
        β: throughput of each state to the point, times its multiple importance sampling weight, over σ̄.
        weight: of the point, when it was taken.
        total: of all points that were offered.
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
        """Nothing was offered yet."""
        ray, medium = dr.zeros(mi.Ray3f), dr.zeros(mi.MediumPtr)
        β = [mi.Spectrum(0) for _ in range(state_count)]
        return Reservoir(ray, mi.Float(0), medium, mi.UInt32(0), β, mi.Float(0), mi.Float(0))

    @property
    def inverse_probability(self) -> Float:
        """1 / probability that the kept point was kept; 0 where there is none."""
        return dr.select(self.weight > 0, self.total / self.weight, 0)


@dataclass
class DifferentialRatioTracking:
    """Loop state of `update_reservoir`.

    Attributes:
        dda: position on the segment.
        β: throughput of each state up to there, ratio-tracked transmittance included.
        reservoir: of the path.
        active: lanes still walking.
    """

    dda: DdaState
    β: list[Spectrum]
    reservoir: Reservoir
    active: Bool


@dr.syntax
def update_reservoir(
    reservoir: Reservoir,
    segment: MediumSegment,
    depth: UInt32,
    β: Sequence[Spectrum],
    sampler: Any,
    active: Bool,
) -> Reservoir:
    """Differential ratio tracking (Nimier-David et al. 2022): points of a segment in proportion to transmittance alone.

    The whole segment is walked with a majorant; each tentative point is offered to the reservoir with the ratio-tracked
    transmittance up to it, whatever the density at the point itself. So points are found where the medium is empty, and
    none is weighted by 1/σₜ.
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
    weighed = [σₜ if segment.by_extinction else σₛ for σₛ, _, σₜ in coefficients]
    offered = [β * mis_complement(σ, c) / σ̄ for β, σ in zip(walk.β, weighed, strict=True)]
    weight = dr.select(walking, total([dr.mean(β) for β in offered]), 0)
    kept = walk.reservoir
    kept.total += weight
    take = walking & (sampler.next_1d() * kept.total < weight)
    kept.ray = dr.select(take, segment.ray, kept.ray)
    kept.t = dr.select(take, t, kept.t)
    kept.medium = dr.select(take, segment.media[0], kept.medium)
    kept.depth = dr.select(take, depth, kept.depth)
    kept.β = [dr.select(take, new, old) for new, old in zip(offered, kept.β, strict=True)]
    kept.weight = dr.select(take, weight, kept.weight)

    walk.β = [β * dr.maximum(1 - σₜ / σ̄, 0) for β, (_, _, σₜ) in zip(walk.β, coefficients, strict=True)]
    most = largest(walk.β)
    # Roulette, relative to what the reservoir holds: points that would hardly be taken are not worth a walk.
    survival = _roulette(most * (segment.far - t) < _FAINT * kept.total, sampler)
    walk.β = [β * survival for β in walk.β]
    walk.active = walking & ~(most <= 0) & (survival > 0)
    walk.dda = dda
    return walk


def relative_derivatives(segment: MediumSegment, t: Float, collides: Bool, noise: Any, inside: Bool) -> list[Spectrum]:
    """Of each state, the derivative of a path's contribution by the medium of a segment, as a share of the contribution (attached; only
    its derivative matters).

    Args:
        t: where the segment ends, if it `collides`.
        noise: random numbers apart from those of the path.
        inside: lanes inside the medium.
    """
    flown = dr.select(collides, t, segment.far) - segment.near
    collision, middle = segment.at(t), segment.at(segment.near + noise.next_1d() * flown)
    c = mis_constant(segment.near, segment.far)
    found = []
    with dr.resume_grad():
        for medium in segment.media:
            depth = flown * medium.get_scattering_coefficients(middle, inside)[2]
            σₛ, _, σₜ = medium.get_scattering_coefficients(collision, collides)
            either = dr.detach(σₛ) + c
            if segment.by_extinction:
                # The weight σₜ/(σₜ + c) over σₛ. At a collision neither is 0.
                either = dr.detach(σₛ) * (1 + c / dr.detach(σₜ))
            found.append(dr.select(collides & (either > 0), σₛ / either, 0) - depth)
    return found


def mis_constant(near: Float, far: Float) -> Float:
    """The constant c of the two estimators of in-scattering's derivative: a collision is weighted by σ/(σ + c), σ being σₛ or σₜ, a
    point of differential ratio tracking by the rest. Any c is unbiased; the density of the latter is about 1/(far - near)."""
    return dr.select(near < far, dr.rcp(far - near), 0)


def mis_complement(σ: Spectrum, c: Float) -> Spectrum:
    """c/(σ + c), 0 where both are."""
    return dr.select(c > 0, c / (σ + c), 0)
