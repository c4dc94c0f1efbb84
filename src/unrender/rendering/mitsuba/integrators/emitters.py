"""Emission along a path: radiance of emitters that its segments hit, and of next-event estimation, combined by MIS.

The visibility (or transmittance) of an emitter is tested separately from its radiance. An emitter that is black in one state therefore
still contributes in the other.
Mitsuba stores an emitter's `sampling_weight` on the host, so a recorded kernel would treat it as a constant. Probabilities of emitter
sampling that change are therefore tables, and the scene's own weights do not change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.rendering.mitsuba.integrators.base import (
    Bool,
    Float,
    PathContext,
    ScatteringVertex,
    Spectrum,
    UInt32,
    registry_id,
)
from unrender.rendering.mitsuba.scene_graph import class_name
from unrender.rendering.renderer import EmitterMoments


def own_probabilities(scene: mi.Scene) -> np.ndarray:
    """Return Mitsuba's probabilities in the order of the scene's emitters, (E,), from their sampling weights; all 0 without weights."""
    weights = np.array([emitter.sampling_weight() for emitter in scene.emitters()], np.float64)
    return weights / weights.sum() if weights.sum() > 0 else weights


def emitter_tables(scene: mi.Scene, probabilities: np.ndarray) -> dict[str, mi.UInt32 | mi.Float]:
    """Return the tables of emitter sampling.

    - "emitter_cdf": 0 and the cumulative sums of the probabilities, (E + 1,).
    - "emitter_ids": registry id of each emitter, (E,).
    - "emitter_pmf": probability by registry id.

    Raises `InputError` if the number of probabilities is not E, one is negative, or their sum is not 1.
    """
    ids = _ids(scene)
    p = np.asarray(probabilities, np.float64)
    if p.shape != ids.shape or not (p >= 0).all() or not abs(p.sum() - 1) < 1e-6:
        raise InputError(
            f"emitters: expected the probabilities of {len(ids)} emitters, of sum 1, got an array of shape {p.shape}"
        )
    cdf = np.concatenate([[0.0], np.cumsum(p)]).astype(np.float32)
    last = int(np.flatnonzero(p)[-1])
    cdf[last + 1 :] = 1.0
    pmf = np.zeros(int(ids.max(initial=0)) + 1, np.float32)
    pmf[ids] = np.diff(cdf)  # from the rounded CDF, so the densities match the samples exactly
    numbers = arrays.owned(ids.astype(np.uint32), mi.UInt32)
    return {
        "emitter_cdf": arrays.owned(cdf, mi.Float),
        "emitter_ids": numbers,
        "emitter_pmf": arrays.owned(pmf, mi.Float),
    }


def connection_moments(scene: mi.Scene, values: mi.Float, emitters: mi.UInt32) -> EmitterMoments:
    """Return the moments by emitter of the connections' values. Each has the registry id of its emitter, 0 for none.

    A value that is not finite counts as 0. The sums run on the host in a fixed order. Atomic sums on a device would differ in their last
    bits between runs.
    """
    ids = _ids(scene)
    index = np.full(int(ids.max(initial=0)) + 1, len(ids))
    index[ids] = np.arange(len(ids))
    where, y = index[emitters.numpy()], values.numpy().astype(np.float64)
    y = np.where(np.isfinite(y), y, 0.0)
    sums, squares = (np.bincount(where, of, len(ids) + 1)[:-1] for of in (y, y * y))
    return EmitterMoments(sums, squares)


def _ids(scene: mi.Scene) -> np.ndarray:
    pointers: Any = scene.emitters_dr()
    ids: Any = dr.reinterpret_array(mi.UInt32, pointers)
    return ids.numpy().astype(np.int64)


_LARGEST = 1e18  # Maximum solid angle density. Twice its square is a finite single-precision number.


def mis_weight(pdf_a: Float, pdf_b: Float) -> Float:
    """Return the weight of strategy a by the power heuristic with exponent 2, detached. It is finite unless a density is NaN.

    Densities of both strategies are clamped to `_LARGEST`, so the two weights still sum to one. A flat emitter seen edge-on has a
    density above 1e19, whose square overflows in single precision.
    """
    # Unlike a minimum, the selection propagates NaN, so that its sample is dropped and counted.
    a, b = (dr.square(dr.select(pdf > _LARGEST, _LARGEST, pdf)) for pdf in (pdf_a, pdf_b))
    return dr.detach(dr.select(a == 0, 0, a / (a + b)))


def _sample_direction(context: PathContext, vertex: mi.Interaction3f, sample: mi.Point2f, active: Bool) -> Any:
    """Return a direction sample to an emitter without a visibility test, and its radiance over its density, with the probabilities in
    `tables` or else the scene's own."""
    if "emitter_cdf" not in context.tables:
        return context.scene.sample_emitter_direction(vertex, sample, False, active)
    cdf, count = context.tables["emitter_cdf"], len(context.scene.emitters())
    index = dr.binary_search(0, count - 1, lambda i: dr.gather(mi.Float, cdf, i + 1, active) <= sample.x)
    first = dr.gather(mi.Float, cdf, index, active)
    pmf = dr.gather(mi.Float, cdf, index + 1, active) - first
    pointer = dr.gather(mi.UInt32, context.tables["emitter_ids"], index, active)
    emitter: Any = dr.reinterpret_array(mi.EmitterPtr, pointer)
    reused = dr.clip((sample.x - first) / pmf, 0, dr.one_minus_epsilon(mi.Float))
    ds, weight = emitter.sample_direction(vertex, mi.Point2f(reused, sample.y), active & (pmf > 0))
    ds.pdf *= pmf
    return ds, weight / pmf


def _pdf_direction(context: PathContext, vertex: mi.Interaction3f, ds: mi.DirectionSample3f, active: Bool) -> Float:
    """Return the solid angle density with which `_sample_direction` samples a point on an emitter."""
    if "emitter_cdf" not in context.tables:
        return context.scene.pdf_emitter_direction(vertex, ds, active)
    emitter: Any = ds.emitter
    pmf = dr.gather(mi.Float, context.tables["emitter_pmf"], registry_id(emitter), active)
    return emitter.pdf_direction(vertex, ds, active) * pmf


_SUNS = {"SunskyEmitter", "TimedSunskyEmitter"}


def has_sun(emitters: Iterable[mi.Emitter]) -> bool:
    return any(class_name(emitter) in _SUNS for emitter in emitters)


def inside_sun(
    ds: Any, sample: mi.Point2f, density: Float, draw: Callable[[mi.Point2f, Bool], Any]
) -> tuple[mi.Vector3f, Bool]:
    """Return the directions of a sample, with those at the edge of the sun moved inside it by other random numbers (`draw`), and the lanes
    of these.

    In single precision the cosine of the sun's angular radius differs from 1 by 180 roundings only. Mitsuba therefore draws 0.4 % of the
    sun's directions so close to its edge that `eval_direction` and `pdf_direction` take them for directions beside the sun.
    """
    edge = ~ds.delta & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite) & (density < 0.5 * ds.pdf)
    # These random numbers draw another point of the same disk. A chord of the disk lies inside it.
    apart = dr.select(sample.y < 0.5, sample.y + 0.5, sample.y - 0.5)
    other = draw(mi.Point2f(sample.x, apart), edge)
    return dr.select(edge, dr.normalize(ds.d + other.d), ds.d), edge


def met_emitter(
    context: PathContext, last: ScatteringVertex, si: mi.SurfaceInteraction3f, active: Bool
) -> tuple[mi.EmitterPtr, Float]:
    """Return the emitter at a surface (or the environment) and the MIS weight of hitting it. For the arguments, see `direct_emission`."""
    ds = mi.DirectionSample3f(context.scene, si=si, ref=last.interaction)
    return ds.emitter, mis_weight(last.pdf, _pdf_direction(context, last.interaction, ds, active & ~last.delta))


def direct_emission(
    context: PathContext,
    last: ScatteringVertex,
    surfaces: Sequence[mi.SurfaceInteraction3f],
    β: Sequence[Spectrum],
    active: Bool,
) -> list[Spectrum]:
    """Return Le of each state: the weighted emission of the surface (or the environment) that BSDF sampling hit from the `last` vertex."""
    emitter, mis = met_emitter(context, last, surfaces[0], active)
    emitters = context.states.emitters(emitter)
    with context.resume_grad():
        return [
            throughput * mis * emitter.eval(surface, active)
            for throughput, emitter, surface in zip(β, emitters, surfaces, strict=True)
        ]


class EmitterConnection:
    """A point sampled on an emitter for next-event estimation at a vertex. The caller removes occluded lanes from `active`.

    With `turning`, the radiance of an environment has derivatives with respect to its rotation.
    """

    def __init__(
        self, context: PathContext, vertex: mi.Interaction3f, sample: mi.Point2f, active: Bool, turning: bool = False
    ):
        self._context, self._vertex, self._turning = context, vertex, turning and not context.primal
        self.ds, weight = _sample_direction(context, vertex, sample, active)
        self.active = active & (self.ds.pdf > 0)  # also false for NaN
        self._seen, self._factor = self.ds, None
        if has_sun(context.scene.emitters()):
            self._look_inside_sun(sample, weight)

    def _look_inside_sun(self, sample: mi.Point2f, weight: Spectrum) -> None:
        """Take the radiance at the edge of the sun from inside, for all states, times a factor for the sampled radiance of the current
        state."""
        context, vertex, ds = self._context, self._vertex, self.ds
        self._seen = dr.copy(ds)
        density = _pdf_direction(context, vertex, ds, self.active)
        self._seen.d, edge = inside_sun(
            ds, sample, density, lambda other, lanes: _sample_direction(context, vertex, other, lanes)[0]
        )
        edge &= self.active
        radiance = ds.emitter.eval_direction(vertex, self._seen, edge)
        factor = dr.clip(weight * ds.pdf / radiance, 0, 2)
        self._factor = mi.Spectrum(dr.select(edge & (radiance != 0), factor, 1))

    @property
    def emitter(self) -> UInt32:
        """Registry id of the emitter, 0 for none."""
        return registry_id(self.ds.emitter)

    def weight(self, pdf: Float) -> Float:
        """Return the MIS weight over the density. For the arguments, see `contributions`."""
        mis = dr.select(self.ds.delta, 1, mis_weight(self.ds.pdf, pdf))
        return dr.select(self.active, mis * dr.rcp(self.ds.pdf), 0)

    def radiance(self, emitter: mi.EmitterPtr, active: Bool) -> Spectrum:
        """Return the radiance of a state's emitter at the vertex. Attached if the caller resumes gradients."""
        radiance = emitter.eval_direction(self._vertex, self._seen, active)
        radiance = self._turned(emitter, radiance) if self._turning else radiance
        return radiance if self._factor is None else radiance * self._factor

    def contributions(self, β: Sequence[Spectrum], values: Sequence[Spectrum], pdf: Float) -> list[Spectrum]:
        """Return Ld of each state: throughput with transmittance, value of BSDF (times cosine) or phase function, emitted radiance and MIS
        weight.

        Attached if the caller resumes gradients. `pdf` is the solid angle density of the current state's BSDF or phase function.
        """
        ds = self.ds
        inv_pdf = dr.select(self.active, dr.rcp(ds.pdf), 0)
        mis = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
        result = []
        for throughput, value, emitter in zip(β, values, self._context.states.emitters(ds.emitter), strict=True):
            radiance = self.radiance(emitter, self.active)
            result.append(dr.select(self.active, throughput * mis * value * (radiance * inv_pdf), 0))
        return result

    def _turned(self, emitter: mi.EmitterPtr, radiance: Spectrum) -> Spectrum:
        """Return the radiance of `emitter.eval_direction`, with the derivative of an environment's radiance in the fixed direction. Mitsuba
        looks it up at the texture coordinates of the sample, which have none."""
        distant = self.active & ~self.ds.delta & mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
        beyond = dr.zeros(mi.SurfaceInteraction3f, dr.width(self.ds))
        beyond.wi, beyond.wavelengths = -self._seen.d, self._vertex.wavelengths
        there = emitter.eval(beyond, distant)
        return dr.select(distant, dr.replace_grad(radiance, there), radiance)
