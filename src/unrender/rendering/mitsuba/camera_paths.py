"""Paths that begin on camera rays, weighted by the sensor."""

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
"""What traces paths."""

Tables = dict[str, Any]
"""{name: `mi.UInt32`}."""


class CameraPaths:
    """The paths that begin on a sensor's rays. What they carry is weighted by the sensor here, and nowhere else: the kernel knows nothing
    of a ray's weight, which need not be 1 (an irradiancemeter's is π). No dataclass: Dr.Jit would take it for state of its loops.

    Args:
        kernel: what traces them.
        scene, tables, sampler, ray, pair, geometry: of `PathKernel.sample`.
        weight: the sensor's, per ray and channel.
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
        """The weighted radiance per lane of the current and, for a pair, of the previous state, else None.

        A lane that is not finite in one state is NaN in both, so both images drop the same samples.
        """
        L, Lₚ = self._sample(dr.ADMode.Primal)
        if Lₚ is None:
            return L * self._weight, None
        return dropped_together(L * self._weight, Lₚ * self._weight)

    def backward(self, *states: tuple[Any, Any]) -> None:
        """Replay the paths backward.

        Args:
            states: (derivative of the loss by the weighted radiance, weighted radiance of the primal pass) per lane, of the current
                and, for a pair, of the previous state, whose derivative is None where its gradient is not wanted.
        """
        replay = [ReplayState(None if δ is None else δ * self._weight, self._replayed(L)) for δ, L in states]
        self._sample(dr.ADMode.Backward, tuple(replay), is_finite(*(L for _, L in states)))

    def forward(self, radiance: Any) -> Any:
        """The derivative of the weighted radiance along the tangents, per lane; `radiance` is that of the primal pass."""
        δ, _ = self._sample(dr.ADMode.Forward, (ReplayState(None, self._replayed(radiance)),), is_finite(radiance))
        return δ * self._weight

    def connections(self, radiance: Any, weights: Any, noise: Any, bounces: int) -> tuple[Any, Any]:
        """What each lane's connections to emitters tell: `ConnectionRecord`'s values and emitters. `radiance`: as for `forward`."""
        assert isinstance(self._kernel, PathPair)
        record = ConnectionRecord(weights * self._weight, noise * self._weight, bounces)
        replay = ReplayState(None, self._replayed(radiance))
        active = is_finite(radiance)
        self._kernel.record_connections(self._scene, self._tables, self._sampler, self._ray, replay, record, active)
        return record.values, record.emitters

    def vertices(self) -> Any:
        """The number of vertices of each lane's path."""
        return self._kernel.vertices(self._scene, self._tables, self._sampler, self._ray, self._geometry)

    def recorded(self, tracer: Callable[..., Any]) -> Any:
        """What another tracer makes of the same rays: a function of scene, tables, sampler, rays and their weights."""
        with dr.suspend_grad():
            return tracer(self._scene, self._tables, self._sampler, self._ray, self._weight)

    def _replayed(self, radiance: Any) -> Any:
        """The radiance as the kernel returned it: what is still ahead at the first vertex of a replay. 0 for dropped samples."""
        return dr.select((self._weight != 0) & is_finite(radiance), radiance / self._weight, 0)

    def _sample(self, mode: dr.ADMode, replay: tuple[ReplayState, ...] = (), active: Any = True) -> tuple[Any, Any]:
        arguments = mode, self._scene, self._tables, self._sampler, self._ray, replay, self._pair
        return self._kernel.sample(*arguments, geometry=self._geometry, active=active)


def is_finite(*states: Any) -> Any:
    """Return which lanes have a finite radiance in every channel of every state. The others are dropped samples."""
    return dr.isfinite(total([dr.sum(radiance) for radiance in states]))


def dropped_together(*states: Any) -> tuple[Any, ...]:
    """Return the radiance of each state, NaN in all of them where it is not finite in one."""
    finite = is_finite(*states)
    return tuple(dr.select(finite, radiance, dr.nan) for radiance in states)
