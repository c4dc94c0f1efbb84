"""Connections to emitters through participating media, and through boundaries that let light pass straight on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators import tracking
from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum
from unrender.rendering.mitsuba.integrators.base import PathContext, carries_light
from unrender.rendering.mitsuba.integrators.tracking import MediumSegment

__all__ = ["Connection", "ConnectionSample", "connect"]


@dataclass
class ConnectionSample:
    """One point of a connection, uniform over its length inside media. State of a Dr.Jit loop, hence mutable.

    Attributes:
        ray: it lies at `t` along this one.
        t: distance.
        medium: where it lies; null where the connection meets no medium.
        length: of the connection inside media.
    """

    ray: mi.Ray3f
    t: Float
    medium: mi.MediumPtr
    length: Float

    @staticmethod
    def empty() -> ConnectionSample:
        """Before any medium."""
        return ConnectionSample(dr.zeros(mi.Ray3f), mi.Float(0), dr.zeros(mi.MediumPtr), mi.Float(0))

    def update(self, segment: MediumSegment, noise: Any) -> None:
        """Extend the connection by a segment, inside whose medium the point may lie."""
        length = segment.far - segment.near
        self.length += length
        take = noise.next_1d() * self.length < length
        self.ray = dr.select(take, segment.ray, self.ray)
        self.medium = dr.select(take, segment.media[0], self.medium)
        self.t = dr.select(take, segment.near + noise.next_1d() * length, self.t)

    def optical_depth(self, medium: mi.MediumPtr) -> Spectrum:
        """The optical depth that this point stands for, in `medium`. Its derivative is that of -log T, unbiased."""
        mei = tracking.medium_interaction(self.ray, self.t)
        return self.length * medium.get_scattering_coefficients(mei, self.length > 0)[2]


@dataclass
class Connection:
    """Loop state of `connect`, and its result.

    Attributes:
        ray: of the next segment.
        medium: that it lies in.
        T: transmittance of each state so far.
        sample: see `connect`.
        active: lanes still on their way.
    """

    ray: mi.Ray3f
    medium: mi.MediumPtr
    T: list[Spectrum]
    sample: ConnectionSample
    active: Bool


@dr.syntax
def connect(
    context: PathContext,
    vertex: mi.Interaction3f,
    target: mi.Point3f,
    medium: mi.MediumPtr,
    sampler: Any,
    noise: Any,
    active: Bool,
) -> tuple[list[Spectrum], ConnectionSample]:
    """Transmittance of each state from `vertex`, which light leaves into `medium`, to `target`.

    With `noise`, random numbers of its own, also a point of the connection.
    """
    ray = vertex.spawn_ray_to(target)
    T = [mi.Spectrum(1) for _ in range(context.state_count)]
    way = Connection(ray, mi.MediumPtr(medium), T, ConnectionSample.empty(), mi.Bool(active))
    while dr.hint(way.active, label="emitter connection"):
        way = _connection_segment(context, target, way, sampler, noise)
    return way.T, way.sample


def _connection_segment(
    context: PathContext, target: mi.Point3f, way: Connection, sampler: Any, noise: Any
) -> Connection:
    ray, medium, active = way.ray, way.medium, way.active
    scene: Any = context.scene
    si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=False, active=active)
    inside = active & (medium != None)  # noqa: E711 (a comparison per lane)
    near, far = tracking.clip_segment(medium, ray, dr.minimum(si.t, ray.maxt), inside)
    segment = MediumSegment(context.tables, context.states.media(medium), ray, near, far, inside)
    passed = tracking.estimate_transmittance(segment, sampler, inside)
    if noise is not None:
        way.sample.update(segment, noise)

    hit = active & si.is_valid()
    surfaces, bsdfs = context.states.interactions(si), context.states.bsdfs(si.bsdf())
    way.T = [
        T * (dr.select(active, through, 1) * dr.select(hit, bsdf.eval_null_transmission(surface, hit), 1))
        for T, through, bsdf, surface in zip(way.T, passed, bsdfs, surfaces, strict=True)
    ]
    way.active = hit & carries_light(way.T)
    way.medium = dr.select(way.active & si.is_medium_transition(), si.target_medium(ray.d), medium)
    way.ray = dr.select(way.active, si.spawn_ray_to(target), ray)
    return way
