"""Common parts of the path-replay kernels: their interface, the adjoint of each state, the constant inputs of a path, and pointers to
the objects of both states.

A kernel traces one state or, for a pair, the current and the previous state on the same paths (Nicolet et al. 2023, section 5 and
appendix B). Quantities that differ between the states are lists with one entry per state, the current one first.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError

# Annotations of per-lane arrays. Mitsuba's stubs treat `mitsuba.Float` and the `drjit.auto.ad.Float` of its methods as different types,
# likewise the others, and do not declare the product of a spectrum and a number. A type checker therefore sees any type.
Float: TypeAlias = Any
Bool: TypeAlias = Any
UInt32: TypeAlias = Any
Spectrum: TypeAlias = Any

while_loop: Any = dr.while_loop
"""`drjit.while_loop`, whose stub only accepts loops of one variable."""


Pointer = TypeVar("Pointer", "mi.BSDFPtr", "mi.EmitterPtr", "mi.ShapePtr", "mi.MediumPtr")


def registry_id(pointer: Any) -> UInt32:
    """Return the registry id of each lane's object, 0 for none."""
    return dr.reinterpret_array(mi.UInt32, pointer)


def remap(table: UInt32, pointer: Pointer) -> Pointer:
    """Return the previous scene's object for the current scene's `pointer`. `table` is one of `ScenePair.tables()`."""
    return dr.reinterpret_array(type(pointer), dr.gather(mi.UInt32, table, registry_id(pointer)))  # pyright: ignore[reportReturnType]


class StatePointers:
    """Objects of each traced state: of the current scene or, for a pair, of the current and of the previous one by `ScenePair.tables()`."""

    def __init__(self, tables: Mapping[str, Any], pair: bool):
        self._tables = tables
        self.pair = pair

    def _of(self, kind: str, pointer: Pointer) -> list[Pointer]:
        return [pointer, remap(self._tables[kind], pointer)] if self.pair else [pointer]

    def bsdfs(self, bsdf: mi.BSDFPtr) -> list[mi.BSDFPtr]:
        return self._of("bsdf", bsdf)

    def emitters(self, emitter: mi.EmitterPtr) -> list[mi.EmitterPtr]:
        return self._of("emitter", emitter)

    def media(self, medium: mi.MediumPtr) -> list[mi.MediumPtr]:
        return self._of("medium", medium)

    def interactions(self, si: mi.SurfaceInteraction3f) -> list[mi.SurfaceInteraction3f]:
        """Return `si` on the shape of each state."""
        if not self.pair:
            return [si]
        siₚ = mi.SurfaceInteraction3f(si)
        siₚ.shape = remap(self._tables["shape"], si.shape)
        return [si, siₚ]


def pointer_table(current: Any, previous: Any) -> mi.UInt32:
    """Return the table from registry ids of one load's pointers to another's. Raises `InputError` if their numbers differ."""
    source = dr.reinterpret_array(mi.UInt32, current).numpy()  # pyright: ignore[reportAttributeAccessIssue]
    target = dr.reinterpret_array(mi.UInt32, previous).numpy()  # pyright: ignore[reportAttributeAccessIssue]
    if source.shape != target.shape:
        raise InputError("scene: two loads of the description differ in their shapes or emitters")
    table = np.zeros(int(source.max(initial=0)) + 1, np.uint32)
    table[source] = target
    return mi.UInt32(table)


KEEP = dr.ADFlag.ClearInput | dr.ADFlag.ClearInterior
"""Flags that keep the graph's edges: two passes traverse those from derived values, such as padded texels, to the parameters."""


@dataclass
class ReplayState:
    """Data of a state's primal pass that the replay of its paths needs.

    Attributes:
        δL: adjoint radiance per lane; None in forward mode, and for the previous state of a pair if its gradient is not requested.
        radiance: radiance per lane of the primal pass (`state_in` of Mitsuba's `prb`).
    """

    δL: Spectrum | None
    radiance: Spectrum


class PathKernel(Protocol):
    """A light transport integrator that renders one state or two, and replays its paths for derivatives."""

    def sample(
        self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f, active: Bool | bool = True
    ) -> tuple[Spectrum, Spectrum | None]:
        """Trace one path per lane of camera rays. Call under `dr.suspend_grad()`. The same seed of the sampler replays the same paths.

        Returns the radiance per lane of the current and, for a pair, of the previous state, both unbiased; in `Forward` mode the derivative
        of the radiance along the tangents, and None. A replay omits the samples that the primal pass dropped.
        """
        ...

    def vertices(self, context: PathContext, sampler: Any, ray: mi.RayDifferential3f) -> Float:
        """Return the number of vertices of each lane's path, without the camera's. For the arguments, see `sample`."""
        ...


class PathContext:
    """Constant inputs of a path. This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.

    Args:
        mode: `Primal`; `Backward` to replay the paths of a primal pass and back-propagate each state's `δL` into the parameters of its
            scene (path replay, Vicini et al. 2021); `Forward` to replay them and propagate the tangents of the parameters of `scene`
            forward (the current state only).
        scene: the current scene.
        tables: `ScenePair.tables()`, used with `pair`, and additional tables of the kernel.
        replay: the current state and, with `pair`, the previous state; () with `Primal`.
        pair: whether the previous state is traced too.
        geometry: object that rays are intersected with instead of `scene` (`poses.Assembly`), or None.
        connections: record of emitter-sampling connections in a forward replay, or None.

    Attributes:
        primal, forward: whether `mode` is `Primal` or `Forward`.
        states: pointers to the objects of each state.
        bsdf_ctx, phase_ctx: contexts with all lobes, for radiance.
    """

    def __init__(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        tables: Mapping[str, Any],
        replay: tuple[ReplayState, ...] = (),
        pair: bool = False,
        geometry: Any = None,
        connections: ConnectionRecord | None = None,
    ):
        self.connections = connections
        self.mode, self.scene, self.tables, self.replay, self.pair = mode, scene, tables, replay, pair
        self.geometry, self.posed = scene if geometry is None else geometry, geometry
        self.primal, self.forward = mode == dr.ADMode.Primal, mode == dr.ADMode.Forward
        self.states = StatePointers(tables, pair)
        self.bsdf_ctx, self.phase_ctx = mi.BSDFContext(), mi.PhaseFunctionContext()

    @property
    def state_count(self) -> int:
        """Number of states: 1, or 2 for a pair."""
        return 2 if self.pair else 1

    def resume_grad(self) -> Any:
        """Return a context that enables derivatives during a replay, but not in a primal pass."""
        return dr.resume_grad(when=not self.primal)

    def materials(self, surfaces: list[mi.SurfaceInteraction3f]) -> list[mi.SurfaceInteraction3f]:
        """Return the interactions with which BSDFs are evaluated, see `Assembly.material`."""
        return surfaces if self.posed is None else [self.posed.material(si) for si in surfaces]

    def initial_radiance(self) -> list[Spectrum]:
        """Return L of each state before the first vertex: 0 or, in a replay, the total radiance."""
        return [mi.Spectrum(0 if self.primal else self.replay[state].radiance) for state in range(self.state_count)]

    def accumulate(self, L: Sequence[Spectrum], *parts: Sequence[Spectrum]) -> list[Spectrum]:
        """Return L of each state after a vertex with the contributions `parts`: they are added or, in a replay, subtracted."""
        combine = operator.add if self.primal else operator.sub
        return [functools.reduce(combine, of_state) for of_state in zip(L, *parts, strict=True)]

    def adjoint_sum(self, contributions: Sequence[Spectrum]) -> Spectrum:
        """Return Σ δL · contribution over the states whose gradient is requested; the contribution itself in forward mode."""
        if self.forward:
            return contributions[0]
        pairs = zip(self.replay, contributions, strict=True)
        return total([replay.δL * part for replay, part in pairs if replay.δL is not None])


class ConnectionRecord:
    """Record of the emitter-sampling connections of paths, see `EmitterSession.emitter_moments`. This is not a dataclass, since Dr.Jit
    would treat a dataclass as loop state.

    Args:
        weights, noise: w / S and n / S of the lanes.
        response: `FilmResponse` of the camera rays.
        bounces: maximum number of connections per path, >= 1.

    Attributes:
        values: y of each lane's connections, (lanes * bounces,), 0 without a connection.
        emitters: registry ids of the sampled emitters, of the same shape.
    """

    def __init__(self, weights: Any, noise: Any, response: Any, bounces: int):
        self._weights, self._noise, self._response, self._bounces = weights, noise, response, bounces
        self._lanes = dr.width(weights)
        self.values = dr.zeros(mi.Float, self._lanes * bounces)
        self.emitters = dr.zeros(mi.UInt32, self._lanes * bounces)
        dr.make_opaque(self.values, self.emitters)

    def write(self, depth: UInt32, emitter: UInt32, f: Spectrum, tangent: Spectrum, active: Bool) -> None:
        """Record a connection of each lane that adds f, with its derivative along the tangents, at a vertex of the given depth, from 0."""
        derivative, sample = self._response.film(tangent), self._response.film(f)
        value = dr.square(dr.sum(self._weights * derivative)) + dr.sum(dr.square(self._noise * sample))
        index = dr.arange(mi.UInt32, self._lanes) * self._bounces + depth
        dr.scatter(self.values, value, index, active)
        dr.scatter(self.emitters, emitter, index, active)


@dataclass
class ScatteringVertex:
    """The last vertex where a path scattered, for the MIS weight of an emitter that its next segment hits. It is state of Dr.Jit loops.

    Attributes:
        pdf: solid angle density of the outgoing direction.
        delta: whether emitter sampling cannot sample that direction: perfectly specular lobes, and the camera.
    """

    interaction: mi.Interaction3f
    pdf: Float
    delta: Bool


def total(parts: Sequence[Any]) -> Any:
    """Return the sum of the parts, in order."""
    return functools.reduce(operator.add, parts)


def carries_light(spectra: Sequence[Spectrum]) -> Bool:
    """Return whether any channel of any state is positive or NaN, per lane. A path with NaN continues, to be counted as dropped at its
    end."""
    return ~(largest(spectra) <= 0)


def largest(spectra: Sequence[Spectrum]) -> Float:
    """Return the largest channel of all states, per lane."""
    return functools.reduce(dr.maximum, [dr.max(spectrum) for spectrum in spectra])


def relative(value: Spectrum) -> Spectrum:
    """Return value / detach(value), 0 where it is zero: the value 1 with the derivative of the logarithm."""
    primal = dr.detach(value)
    return dr.select(primal != 0, value / primal, 0)
