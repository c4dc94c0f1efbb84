"""What the path-replay kernels share: their interface, the adjoint of each state, and what a path reads but never changes.

A kernel traces one state or, for a pair, the current and the previous state on the same paths (Nicolet et al. 2023, section 5 and
appendix B). Quantities that differ between the states are lists with one entry per state, the current one first.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.array_types import Bool, Float, Spectrum, UInt32
from unrender.rendering.mitsuba.integrators.pointer_tables import StatePointers

KEEP = dr.ADFlag.ClearInput | dr.ADFlag.ClearInterior
"""Two passes go the way from what the scene makes of its parameters (such as padded texels) back to them: the first must not use it up."""


@dataclass
class ReplayState:
    """What replaying the paths of one state needs of its primal pass.

    Attributes:
        δL: adjoint radiance per lane; None in forward mode, and for the previous state of a pair where its gradient is not wanted.
        radiance: per lane, as the primal pass returned it (`state_in` of Mitsuba's `prb`).
    """

    δL: Spectrum | None
    radiance: Spectrum


class PathKernel(Protocol):
    """A light transport integrator that renders one state or two, and replays its paths for derivatives."""

    def sample(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        tables: Mapping[str, Any],
        sampler: Any,
        ray: mi.RayDifferential3f,
        replay: tuple[ReplayState, ...] = (),
        pair: bool = False,
        geometry: Any = None,
        active: Bool | bool = True,
    ) -> tuple[Spectrum, Spectrum | None]:
        """Trace one path per lane. Call under `dr.suspend_grad()`.

        Args:
            mode: `Primal`; `Backward` to replay the paths of a primal pass and back-propagate each state's `δL` into the parameters of
                its scene (path replay, Vicini et al. 2021); `Forward` to replay them and carry the tangents of the parameters of
                `scene` forward (the current state only).
            scene: the current scene.
            tables: of `ScenePair.tables()`, used with `pair`, and what the kernel at hand asks for beyond these.
            sampler: seeded; the same seed replays the same paths.
            ray: camera rays.
            replay: the current state and, with `pair`, the previous state; () with `Primal`.
            pair: whether the previous state is traced too.
            geometry: what rays are intersected with in place of `scene` (`poses.Assembly`), or None.
            active: lanes that are traced. A replay leaves out the samples that the primal pass dropped.

        Returns:
            radiance per lane of the current and, with `pair`, of the previous state, both unbiased; with `Forward` the derivative of the
            radiance along the tangents, and None.
        """
        ...

    def vertices(
        self,
        scene: mi.Scene,
        tables: Mapping[str, Any],
        sampler: Any,
        ray: mi.RayDifferential3f,
        geometry: Any = None,
    ) -> Float:
        """How many vertices each lane's path has, the camera's not counted: what it costs to trace. Arguments as for `sample`."""
        ...


class PathContext:
    """What a path reads and never changes. No dataclass: Dr.Jit would take it for state of its loops.

    Args:
        mode, scene, tables, replay, pair, geometry: of `PathKernel.sample`.
        connections: where a replay forward writes what connections to emitters add; None for nowhere.

    Attributes:
        primal, forward: whether `mode` is that.
        states: of each state, its objects.
        bsdf_ctx, phase_ctx: all lobes, radiance.
    """

    def __init__(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        tables: Mapping[str, Any],
        replay: tuple[ReplayState, ...],
        pair: bool,
        geometry: Any = None,
        connections: ConnectionRecord | None = None,
    ):
        self.connections = connections
        self.mode, self.scene, self.tables, self.replay, self.pair = mode, scene, tables, replay, pair
        self.geometry = scene if geometry is None else geometry
        self.primal, self.forward = mode == dr.ADMode.Primal, mode == dr.ADMode.Forward
        self.states = StatePointers(tables, pair)
        self.bsdf_ctx, self.phase_ctx = mi.BSDFContext(), mi.PhaseFunctionContext()

    @property
    def state_count(self) -> int:
        """1, or 2 for a pair."""
        return 2 if self.pair else 1

    def resume_grad(self) -> Any:
        """Derivatives where paths are replayed, none in a primal pass."""
        return dr.resume_grad(when=not self.primal)

    def initial_radiance(self) -> list[Spectrum]:
        """L of each state before the first vertex: none gathered yet or, to replay, all of it still ahead."""
        return [mi.Spectrum(0 if self.primal else self.replay[state].radiance) for state in range(self.state_count)]

    def accumulate(self, L: Sequence[Spectrum], *parts: Sequence[Spectrum]) -> list[Spectrum]:
        """L of each state after a vertex that gave `parts`: more gathered or, in a replay, less still ahead."""
        combine = operator.add if self.primal else operator.sub
        return [functools.reduce(combine, of_state) for of_state in zip(L, *parts, strict=True)]

    def adjoint_sum(self, contributions: Sequence[Spectrum]) -> Spectrum:
        """Σ δL · contribution over the states whose gradient is wanted; the contribution itself in forward mode."""
        if self.forward:
            return contributions[0]
        pairs = zip(self.replay, contributions, strict=True)
        return total([replay.δL * part for replay, part in pairs if replay.δL is not None])


class ConnectionRecord:
    """What the connections of paths to emitters add: see `EmitterSession.emitter_moments`. No dataclass: Dr.Jit would take it for state
    of its loops.

    Args:
        weights, noise: w / S and n / S of the lanes.
        bounces: connections of a path at most, >= 1.

    Attributes:
        values: y of each lane's connections, (lanes * bounces,), 0 where there is none.
        emitters: likewise the registry id of the emitter that was drawn.
    """

    def __init__(self, weights: Spectrum, noise: Spectrum, bounces: int):
        self._weights, self._noise, self._bounces = weights, noise, bounces
        self._lanes = dr.width(weights)
        self.values = dr.zeros(mi.Float, self._lanes * bounces)
        self.emitters = dr.zeros(mi.UInt32, self._lanes * bounces)
        dr.make_opaque(self.values, self.emitters)

    def write(self, depth: UInt32, emitter: UInt32, f: Spectrum, tangent: Spectrum, active: Bool) -> None:
        """A connection of each lane that adds f, with a derivative along the tangents, at a vertex of that depth, counted from 0."""
        value = dr.square(dr.sum(self._weights * tangent)) + dr.sum(dr.square(self._noise * f))
        index = dr.arange(mi.UInt32, self._lanes) * self._bounces + depth
        dr.scatter(self.values, value, index, active)
        dr.scatter(self.emitters, emitter, index, active)


@dataclass
class ScatteringVertex:
    """The last vertex where a path scattered, for the MIS weight of emitters that its next segment meets. State of Dr.Jit loops.

    Attributes:
        interaction: where.
        pdf: solid angle density of the direction in which the path left.
        delta: whether no emitter sample competes with that direction: perfectly specular lobes, and the camera.
    """

    interaction: mi.Interaction3f
    pdf: Float
    delta: Bool


def total(parts: Sequence[Any]) -> Any:
    """Their sum, in order."""
    return functools.reduce(operator.add, parts)


def carries_light(spectra: Sequence[Spectrum]) -> Bool:
    """Whether any channel of any state is above zero or no number, per lane: a broken path goes on, to be counted as such at its end."""
    return ~(largest(spectra) <= 0)


def largest(spectra: Sequence[Spectrum]) -> Float:
    """The largest channel of all states, per lane."""
    return functools.reduce(dr.maximum, [dr.max(spectrum) for spectrum in spectra])


def relative(value: Spectrum) -> Spectrum:
    """value / detach(value), 0 where it is zero: one, with the derivative of the logarithm."""
    primal = dr.detach(value)
    return dr.select(primal != 0, value / primal, 0)
