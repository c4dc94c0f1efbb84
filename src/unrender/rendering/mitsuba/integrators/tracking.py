"""Sampling along a ray in a participating medium: free flight and transmittance.

Symbols: σ̄ majorant (one number per lane that bounds all channels of all states), σₜ extinction, σₛ scattering, β throughput, T
transmittance. Media, throughputs and transmittances are lists with one entry per state, the current state first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.base import Bool, Float, Spectrum, largest, total
from unrender.rendering.mitsuba.integrators.majorant_supergrid import DdaState, HomogeneousMajorant, SupergridTraversal

FAINT = 0.1
"""Transmittance below which Russian roulette may terminate tracking."""


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
        near, far: results of `clip_segment`.
        active: lanes inside the medium.
        by_extinction: whether the MIS weights of the in-scattering derivative use σₜ instead of σₛ. This is cheaper if σₛ is expensive
            to evaluate, and requires σₛ > 0 wherever σₜ > 0: as for the emission of a radiance field.
        size: see `distance_scale`.

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
        size: float = 0.0,
    ):
        self.media, self.ray, self.near, self.far = media, ray, near, far
        self.by_extinction, self.size = by_extinction, size
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
    """Loop state of `sample_free_flight`, and its result: whether the collision at `dda.t` is real, and the throughput of each state."""

    dda: DdaState
    β: list[Spectrum]
    collides: Bool
    active: Bool


@dr.syntax
def sample_free_flight(
    segment: MediumSegment, β: Sequence[Spectrum], sampler: Any, active: Bool
) -> tuple[Float, Bool, list[Spectrum]]:
    """Sample a collision on a segment: in closed form for homogeneous media, else by delta tracking.

    The probability of a real collision weights all channels of all states by their throughput. The sum of all throughputs is then constant,
    so none of them diverges. Returns the distance, whether there is one, and the throughputs, including σₛ over the density.
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
    """Loop state of `estimate_transmittance`: the transmittance of each state up to a position on the segment."""

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
    survival = roulette(walking & (most < FAINT), sampler)
    walk.T = [T * survival for T in walk.T]
    walk.active = walking & ~(most <= 0) & (survival > 0)
    walk.dda = dda
    return walk


def roulette(faint: Bool, sampler: Any) -> Float:
    """Return the weight of Russian roulette: 1, or 2 or 0 for `faint` lanes."""
    return dr.select(faint, dr.select(sampler.next_1d() < 0.5, 2.0, 0.0), 1.0)
