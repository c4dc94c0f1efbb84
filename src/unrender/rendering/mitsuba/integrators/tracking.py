# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Steps through a participating medium: where a ray collides, what passes, and where its derivative is looked for.

Symbols: σ̄ majorant (one number per lane that bounds all channels, of both states, see `majorant_grid.py`), σₜ extinction,
σₛ scattering, β throughput, T transmittance. A subscript ₚ marks the previous state. With `pair` false its arguments are not looked
at, and what is returned for it is to be ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.majorant_grid import Cells, Uniform

_FAINT = 0.1
"""Below this transmittance, roulette decides whether a walk through a medium goes on."""

_POINTS = 4.0
"""Tentative points on a segment, in the mean at least, where a derivative is looked for: an empty medium has none of its own."""


def at(ray: Any, t: Any) -> Any:
    """The point of a medium at distance `t` along a ray, `mi.MediumInteraction3f`."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.t = t
    mei.p = ray(t)
    mei.wi = -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time = ray.time
    mei.wavelengths = ray.wavelengths
    return mei


def clip_segment(medium: Any, ray: Any, reach: Any, active: Any) -> tuple[Any, Any]:
    """From where to where a ray that ends at `reach` is inside the bounding box of a medium; (0, 0) where it is not."""
    hit, near, far = medium.intersect_aabb(ray)
    near, far = dr.maximum(near, 0), dr.minimum(far, reach)
    inside = active & hit & (near < far)
    return dr.select(inside, near, 0), dr.select(inside, far, 0)


def bounds(
    tables: Any, medium: Any, mediumₚ: Any, ray: Any, near: Any, far: Any, active: Any, pair: bool
) -> Uniform | Cells:
    """Bounds of the extinction of all channels from `near` to `far`, of both states with `pair`: by the coarse grids in `tables`, where it
    has them, else by the medium's own majorant."""
    grids = "majorants" in tables
    σ̄ = None
    if not (grids and tables["every"]):
        mei = at(ray, mi.Float(0))
        σ̄ = dr.max(medium.get_majorant(mei, active))
        if pair:
            σ̄ = dr.maximum(σ̄, dr.max(mediumₚ.get_majorant(mei, active)))
        σ̄ = dr.select(active, dr.detach(σ̄), 0)
    return Cells(tables, medium, ray, near, far, σ̄, active) if grids else Uniform(σ̄, near, far)


def free_depth(u: Any) -> Any:
    """The optical depth of majorants to the next tentative collision."""
    return -dr.log(1 - u)


@dr.syntax
def sample_free_flight(
    medium: Any,
    mediumₚ: Any,
    ray: Any,
    bound: Uniform | Cells,
    β: Any,
    βₚ: Any,
    sampler: Any,
    active: Any,
    pair: bool,
) -> tuple[Any, Any, Any, Any]:
    """Delta tracking through a segment.

    A tentative collision is real with a probability that weighs all channels of both states by their throughput: the
    sum of all throughputs then stays as it is at every null collision, so none of them explodes.

    Returns:
        distance of the real collision, whether there is one, and the throughputs, σₛ over its density included.
    """
    place = bound.start()
    real = mi.Bool(False)
    flying = active & (bound.near < bound.far)
    while dr.hint(flying, label="free flight"):
        place = bound.advance(place, free_depth(sampler.next_1d()), flying)
        flying &= place.t < bound.far
        σ̄ = place.σ̄
        mei = at(ray, place.t)
        σₜ = medium.get_scattering_coefficients(mei, flying)[2]
        share, total = dr.sum(β * σₜ), dr.sum(β)
        if dr.hint(pair, mode="scalar"):
            σₜₚ = mediumₚ.get_scattering_coefficients(mei, flying)[2]
            share += dr.sum(βₚ * σₜₚ)
            total += dr.sum(βₚ)
        p = dr.clip(share / (σ̄ * total), 0, 1)
        real = flying & (sampler.next_1d() < p)
        null = flying & ~real
        scale = dr.rcp(dr.select(real, p, 1 - p) * σ̄)
        β = dr.select(flying, β * scale * dr.select(real, 1, dr.maximum(σ̄ - σₜ, 0)), β)
        if dr.hint(pair, mode="scalar"):
            βₚ = dr.select(flying, βₚ * scale * dr.select(real, 1, dr.maximum(σ̄ - σₜₚ, 0)), βₚ)
        flying = null
    # Only here, since an albedo is dear to look up and null collisions need none.
    mei = at(ray, place.t)
    β *= dr.select(real, medium.get_scattering_coefficients(mei, real)[0], 1)
    if dr.hint(pair, mode="scalar"):
        βₚ *= dr.select(real, mediumₚ.get_scattering_coefficients(mei, real)[0], 1)
    return place.t, real, β, βₚ


@dr.syntax
def estimate_transmittance(
    medium: Any, mediumₚ: Any, ray: Any, bound: Uniform | Cells, sampler: Any, active: Any, pair: bool
) -> tuple[Any, Any]:
    """Transmittance of a segment in both states: in closed form where the medium is homogeneous, else by ratio tracking."""
    near, far = bound.near, bound.far
    active = active & (near < far)
    closed = active & medium.is_homogeneous()
    mei = at(ray, near)
    T = dr.select(closed, dr.exp(-medium.get_scattering_coefficients(mei, closed)[2] * (far - near)), 1)
    Tₚ = mi.Spectrum(T)
    if dr.hint(pair, mode="scalar"):
        Tₚ = dr.select(closed, dr.exp(-mediumₚ.get_scattering_coefficients(mei, closed)[2] * (far - near)), 1)
    place = bound.start()
    walking = active & ~closed
    while dr.hint(walking, label="ratio tracking"):
        place = bound.advance(place, free_depth(sampler.next_1d()), walking)
        walking &= place.t < far
        σ̄ = place.σ̄
        mei = at(ray, place.t)
        T = dr.select(walking, T * dr.maximum(1 - medium.get_scattering_coefficients(mei, walking)[2] / σ̄, 0), T)
        most = dr.max(T)
        if dr.hint(pair, mode="scalar"):
            σₜₚ = mediumₚ.get_scattering_coefficients(mei, walking)[2]
            Tₚ = dr.select(walking, Tₚ * dr.maximum(1 - σₜₚ / σ̄, 0), Tₚ)
            most = dr.maximum(most, dr.max(Tₚ))
        faint = walking & (most < _FAINT)
        survival = dr.select(faint, dr.select(sampler.next_1d() < 0.5, 2.0, 0.0), 1.0)
        T *= survival
        Tₚ *= survival
        walking &= (most > 0) & (survival > 0)
    return T, Tₚ


@dataclass
class Reservoir:
    """One point of a path, kept of all those where in-scattering might begin.

    State of Dr.Jit loops, hence mutable.

    Attributes:
        ray: it lies at `t` along this one.
        t: distance.
        medium: where it lies.
        depth: of the path before it.
        β, βₚ: throughput to the point, both states, times its multiple importance sampling weight, over σ̄.
        weight: of the point, when it was taken.
        total: of all points that were offered.
    """

    ray: Any
    t: Any
    medium: Any
    depth: Any
    β: Any
    βₚ: Any
    weight: Any
    total: Any

    @staticmethod
    def empty() -> Reservoir:
        """Nothing was offered yet."""
        ray, zero = dr.zeros(mi.Ray3f), mi.Spectrum(0)
        medium, none = dr.zeros(mi.MediumPtr), mi.Float(0)
        return Reservoir(ray, mi.Float(0), medium, mi.UInt32(0), zero, mi.Spectrum(0), none, mi.Float(0))


@dr.syntax
def update_reservoir(
    kept: Reservoir,
    medium: Any,
    mediumₚ: Any,
    ray: Any,
    bound: Uniform | Cells,
    depth: Any,
    β: Any,
    βₚ: Any,
    noise: Any,
    active: Any,
    pair: bool,
) -> Reservoir:
    """Differential ratio tracking (Nimier-David et al. 2022): points of a segment in proportion to transmittance alone.

    The whole segment is walked with a majorant; each tentative point is offered to the reservoir with the ratio-tracked
    transmittance up to it, whatever the density at the point itself. So points are found where the medium is empty, and
    none is weighted by 1/σₜ.
    """
    near, far = bound.near, bound.far
    active = active & (near < far)
    c = balance(near, far)
    bound = bound.at_least(dr.select(active, _POINTS / (far - near), 0))
    place = bound.start()
    β = mi.Spectrum(β)
    βₚ = mi.Spectrum(βₚ)
    walking = active & (c > 0)
    while dr.hint(walking, label="differential ratio tracking"):
        place = bound.advance(place, free_depth(noise.next_1d()), walking)
        walking &= place.t < far
        t, σ̄ = place.t, place.σ̄
        mei = at(ray, t)
        σₛ, _, σₜ = medium.get_scattering_coefficients(mei, walking)
        offered = β * complement(σₛ, c) / σ̄
        weight = dr.mean(offered)
        offeredₚ = mi.Spectrum(0)
        if dr.hint(pair, mode="scalar"):
            σₛₚ, _, σₜₚ = mediumₚ.get_scattering_coefficients(mei, walking)
            offeredₚ = βₚ * complement(σₛₚ, c) / σ̄
            weight += dr.mean(offeredₚ)
        weight = dr.select(walking, weight, 0)
        kept.total += weight
        take = walking & (noise.next_1d() * kept.total < weight)
        kept.ray = dr.select(take, ray, kept.ray)
        kept.t = dr.select(take, t, kept.t)
        kept.medium = dr.select(take, medium, kept.medium)
        kept.depth = dr.select(take, depth, kept.depth)
        kept.β = dr.select(take, offered, kept.β)
        kept.βₚ = dr.select(take, offeredₚ, kept.βₚ)
        kept.weight = dr.select(take, weight, kept.weight)

        β *= dr.maximum(1 - σₜ / σ̄, 0)
        most = dr.max(β)
        if dr.hint(pair, mode="scalar"):
            βₚ *= dr.maximum(1 - σₜₚ / σ̄, 0)
            most = dr.maximum(most, dr.max(βₚ))
        # Roulette, relative to what the reservoir holds: points that would hardly be taken are not worth a walk.
        faint = most * (far - t) < _FAINT * kept.total
        survival = dr.select(faint, dr.select(noise.next_1d() < 0.5, 2.0, 0.0), 1.0)
        β *= survival
        βₚ *= survival
        walking &= (most > 0) & (survival > 0)
    return kept


def balance(near: Any, far: Any) -> Any:
    """The constant c of the two estimators of in-scattering's derivative: a collision is weighted by σₛ/(σₛ + c), a point of
    differential ratio tracking by the rest. Any c is unbiased; the density of the latter is about 1/(far - near)."""
    return dr.select(near < far, dr.rcp(far - near), 0)


def complement(σₛ: Any, c: Any) -> Any:
    """c/(σₛ + c), 0 where both are."""
    return dr.select(c > 0, c / (σₛ + c), 0)
