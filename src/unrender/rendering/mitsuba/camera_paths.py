"""Paths that begin on camera rays, weighted by the sensor's importance, and what their adjoints need of a rendering."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.core.checks import DropReport
from unrender.core.trees import Tree
from unrender.rendering.mitsuba import film
from unrender.rendering.mitsuba.film_response import FilmResponse, film_samples, with_film
from unrender.rendering.mitsuba.integrators.aov import AovKernel
from unrender.rendering.mitsuba.integrators.base import ConnectionRecord, PathContext, ReplayState, total
from unrender.rendering.mitsuba.integrators.path import PathPair, PrbKernel
from unrender.rendering.mitsuba.integrators.volpath import VolumePair
from unrender.rendering.renderer import SampleRequest, Space

Kernel = PathPair | VolumePair | PrbKernel | AovKernel
"""Kernel that traces paths."""

Tables = dict[str, Any]
"""{name: `mi.UInt32`}."""


class CameraPaths:
    """Paths that begin on a sensor's rays. The sensor's weights are applied here only: kernels return unweighted radiance, and a ray's
    weight need not be 1 (an irradiancemeter's is π).

    This is not a dataclass, since Dr.Jit would treat a dataclass as loop state.
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
        self._kernel, self._pair, self._geometry = kernel, pair, geometry
        self.scene, self.tables, self.sampler, self.ray = scene, tables, sampler, ray
        self.response = FilmResponse(weight, ray.wavelengths, tables)

    def context(
        self,
        mode: dr.ADMode = dr.ADMode.Primal,
        replay: tuple[ReplayState, ...] = (),
        connections: ConnectionRecord | None = None,
    ) -> PathContext:
        """Return the constant inputs of these paths."""
        return PathContext(mode, self.scene, self.tables, replay, self._pair, self._geometry, connections)

    def primal(self) -> Callable[[], tuple[Any, Any]]:
        """Return the kernel with the arguments of these paths. `weighted` converts its result to the sensor's radiance."""
        return self._sample(dr.ADMode.Primal)

    def weighted(self, L: Any, Lₚ: Any) -> tuple[Any, Any]:
        """Return the stored radiance (`FilmResponse.stored`) of the current and, for a pair, of the previous state, else None.

        A lane that is not finite in one state is NaN in both, so both images drop the same samples.
        """
        if Lₚ is None:
            return self.response.stored(L), None
        return dropped_together(self.response.stored(L), self.response.stored(Lₚ))

    def backward(self, *states: tuple[Any, Any]) -> Callable[[], Any]:
        """Return the kernel with the arguments of the backward replay of these paths.

        Args:
            states: (derivative of the loss by the sample of the film, stored radiance of the primal pass) per lane, for the current
                and, for a pair, the previous state. The derivative is None if the state's gradient is not requested.
        """
        replay = [ReplayState(None if δ is None else self.response.pull_back(δ), self._replayed(L)) for δ, L in states]
        return self._sample(dr.ADMode.Backward, tuple(replay), is_finite(*(L for _, L in states)))

    def forward(self, radiance: Any) -> Callable[[], tuple[Any, Any]]:
        """Return the kernel with the arguments of the forward replay of these paths. It returns the derivative along the tangents, without
        the sensor's weight.

        `radiance` is that of the primal pass.
        """
        return self._sample(dr.ADMode.Forward, (ReplayState(None, self._replayed(radiance)),), is_finite(radiance))

    def connections(
        self, radiance: Any, weights: Any, noise: Any, bounces: int
    ) -> Callable[[], ConnectionRecord | None]:
        """Return the kernel with the arguments that record each lane's connections to emitters. `radiance`: as for `forward`."""
        assert isinstance(self._kernel, PathPair)
        record = ConnectionRecord(weights, noise, self.response, bounces)
        context = self.context(dr.ADMode.Forward, (ReplayState(None, self._replayed(radiance)),), record)
        return functools.partial(self._kernel.record_connections, context, self.sampler, self.ray, is_finite(radiance))

    def vertices(self) -> Callable[[], Any]:
        """Return the kernel with the arguments that count the vertices of each lane's path."""
        return functools.partial(self._kernel.vertices, self.context(), self.sampler, self.ray)

    def _replayed(self, radiance: Any) -> Any:
        """Return the unweighted radiance of the kernel, which is the remaining radiance at the start of a replay; 0 for dropped samples."""
        return self.response.replayed(radiance, is_finite(radiance))

    def _sample(
        self, mode: dr.ADMode, replay: tuple[ReplayState, ...] = (), active: Any = True
    ) -> Callable[[], tuple[Any, Any]]:
        return functools.partial(self._kernel.sample, self.context(mode, replay), self.sampler, self.ray, active)


def is_finite(*states: Any) -> Any:
    """Return which lanes have a finite radiance in every channel of every state. The other lanes are dropped samples."""
    return dr.isfinite(total([dr.sum(film_samples(radiance)) for radiance in states]))


def dropped_together(*states: Any) -> tuple[Any, ...]:
    """Return the radiance of each state, NaN in all states for a lane that is not finite in one of them."""
    finite = is_finite(*states)
    return tuple(with_film(state, dr.select(finite, film_samples(state), dr.nan)) for state in states)


@dataclass(frozen=True)
class Paths:
    """State of a rendering that `adjoint` needs to replay its paths.

    Attributes:
        radiance: radiance per lane (`FilmResponse.stored`).
        radiance_previous: that of the previous state; None unless a pair was rendered.
        space: sample space of the pair.
        previous: parameters of the previous state; None unless a pair was rendered.
        vertices: result of `TracePass` if paths are cached; else None.
        keys: parameters whose lookups the vertices refer to.
    """

    request: SampleRequest
    radiance: Any
    radiance_previous: Any = None
    space: Space = "path"
    previous: Tree | None = None
    vertices: dict[str, Any] | None = None
    keys: tuple[str, ...] = ()


_MOST_PENDING = 64  # maximum number of launches with unread counts, since each reading waits for all launches before it
_PENDING_SHARE = 8
"""At most one of so many launches has an unread count, so that short runs report their dropped samples, too."""


class DroppedSamples:
    """Samples whose radiance is not finite. They contribute nothing to an image or a gradient, and are counted: each launch `at_once`, or
    several together, so that launches overlap."""

    def __init__(self, at_once: bool) -> None:
        self._report = DropReport()
        self._at_once = at_once
        self._pending: list[tuple[Any, int]] = []
        self._launches = 0

    @property
    def count(self) -> int:
        """Number of samples dropped so far."""
        self.read()
        return self._report.count

    def develop(self, radiance: Any, spp: int, groups: int, shape: tuple[int, ...]) -> mi.TensorXf:
        """Return the image that `film.develop` makes of the finite samples, and count the dropped ones."""
        self._launches += 1
        if len(self._pending) > min(_MOST_PENDING, self._launches // _PENDING_SHARE):
            self.read()
        samples = film_samples(radiance)
        finite, lanes = is_finite(samples), dr.width(samples)
        finite_radiance = mi.Color3f(dr.select(finite, samples, 0))
        dropped = dr.count(~finite)
        dr.eval(finite_radiance, dropped)
        self._pending.append((dropped, lanes))
        if self._at_once:
            self.read()
        return film.develop(finite_radiance, spp, groups, shape)

    def read(self) -> None:
        """Add up the counts of earlier launches."""
        for dropped, lanes in self._pending:
            self._report.add(int(dropped.numpy()[0]), lanes, "samples of a picture are not finite")
        self._pending.clear()
