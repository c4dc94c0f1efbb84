"""Paths that begin on camera rays, weighted by the sensor's importance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.rendering.mitsuba.integrators.base import ConnectionRecord, ReplayState, total
from unrender.rendering.mitsuba.integrators.path import PathPair
from unrender.rendering.mitsuba.integrators.prb import PrbKernel
from unrender.rendering.mitsuba.integrators.volpath import VolumePair

Kernel = PathPair | VolumePair | PrbKernel
"""Kernel that traces paths."""

Tables = dict[str, Any]
"""{name: `mi.UInt32`}."""


class CameraPaths:
    """Paths that begin on a sensor's rays. The sensor's weights are applied here only: kernels return unweighted radiance, and a ray's
    weight need not be 1 (an irradiancemeter's is π).

    This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.

    Args:
        kernel: kernel that traces the paths.
        scene, tables, sampler, ray, pair, geometry: arguments of `PathKernel.sample`.
        weight: the sensor's weight per ray and channel.
    """

    def __init__(
        self,
        kernel: Kernel,
        scene: mi.Scene,
        tables: Tables,
        sampler: Any,
        ray: Any,
        weight: mi.Spectrum,
        pair: bool,
        geometry: Any = None,
    ):
        self._kernel, self._scene, self._tables, self._sampler = kernel, scene, tables, sampler
        self._ray, self._weight, self._pair, self._geometry = ray, weight, pair, geometry

    def radiance(self) -> tuple[Any, Any]:
        """Return the weighted radiance per lane of the current state and, for a pair, of the previous state, else None.

        A lane that is not finite in one state is NaN in both, so both images drop the same samples.
        """
        L, Lₚ = self._sample(dr.ADMode.Primal)
        if Lₚ is None:
            return L * self._weight, None
        return dropped_together(L * self._weight, Lₚ * self._weight)

    def backward(self, *states: tuple[Any, Any]) -> None:
        """Replay the paths in backward mode.

        Args:
            states: (derivative of the loss by the weighted radiance, weighted radiance of the primal pass) per lane, for the current
                and, for a pair, the previous state. The derivative is None if the state's gradient is not requested.
        """
        replay = [ReplayState(None if δ is None else δ * self._weight, self._replayed(L)) for δ, L in states]
        self._sample(dr.ADMode.Backward, tuple(replay), is_finite(*(L for _, L in states)))

    def forward(self, radiance: Any) -> Any:
        """Return the derivative of the weighted radiance along the tangents, per lane. `radiance` is that of the primal pass."""
        δ, _ = self._sample(dr.ADMode.Forward, (ReplayState(None, self._replayed(radiance)),), is_finite(radiance))
        return δ * self._weight

    def connections(self, radiance: Any, weights: Any, noise: Any, bounces: int) -> tuple[Any, Any]:
        """Return values and emitters of each lane's emitter-sampling connections, see `ConnectionRecord`. `radiance` is that of the
        primal pass."""
        assert isinstance(self._kernel, PathPair)
        record = ConnectionRecord(weights * self._weight, noise * self._weight, bounces)
        replay = ReplayState(None, self._replayed(radiance))
        active = is_finite(radiance)
        self._kernel.record_connections(self._scene, self._tables, self._sampler, self._ray, replay, record, active)
        return record.values, record.emitters

    def vertices(self) -> Any:
        """Return the number of vertices of each lane's path."""
        return self._kernel.vertices(self._scene, self._tables, self._sampler, self._ray, self._geometry)

    def recorded(self, tracer: Callable[..., Any]) -> Any:
        """Return the result of another tracer for the same rays: a function of scene, tables, sampler, rays and their weights."""
        with dr.suspend_grad():
            return tracer(self._scene, self._tables, self._sampler, self._ray, self._weight)

    def _replayed(self, radiance: Any) -> Any:
        """Return the unweighted radiance of the kernel, which is the remaining radiance at the start of a replay; 0 for dropped
        samples."""
        return dr.select((self._weight != 0) & is_finite(radiance), radiance / self._weight, 0)

    def _sample(self, mode: dr.ADMode, replay: tuple[ReplayState, ...] = (), active: Any = True) -> tuple[Any, Any]:
        arguments = mode, self._scene, self._tables, self._sampler, self._ray, replay, self._pair
        return self._kernel.sample(*arguments, geometry=self._geometry, active=active)


def is_finite(*states: Any) -> Any:
    """Return which lanes have a finite radiance in every channel of every state. The other lanes are dropped samples."""
    return dr.isfinite(total([dr.sum(radiance) for radiance in states]))


def dropped_together(*states: Any) -> tuple[Any, ...]:
    """Return the radiance of each state, NaN in all states for a lane that is not finite in one of them."""
    finite = is_finite(*states)
    return tuple(dr.select(finite, radiance, dr.nan) for radiance in states)
