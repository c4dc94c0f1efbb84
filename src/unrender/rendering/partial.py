"""Two views of a renderer: one that differentiates some of its parameters alone, and one that holds some of them at given values."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.trees import Tree
from unrender.rendering.renderer import (
    EmitterMoments,
    ParameterInfo,
    Renderer,
    Rendering,
    RenderSession,
    SampleRequest,
    Space,
    counted_vertices,
    differentiated,
    drawing_emitters,
    with_differential_bsdf,
)

__all__ = ["HeldParameters", "PartialDerivatives"]


@dataclass(frozen=True, eq=False)
class _View:
    """What both views leave to the renderer."""

    inner: Renderer

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """See `Renderer.parameters`."""
        return self.inner.parameters()

    def values(self, keys: list[str]) -> Tree:
        """See `Renderer.values`."""
        return self.inner.values(keys)

    def resolutions(self) -> list[tuple[int, int]]:
        """See `Renderer.resolutions`."""
        return self.inner.resolutions()

    def array(self, values: np.ndarray) -> Array:
        """See `Renderer.array`."""
        return self.inner.array(values)


@dataclass(frozen=True, eq=False)
class PartialDerivatives(_View):
    """A renderer that changes all parameters and differentiates all but some: the derivatives by these are returned as 0.

    They need not be differentiable: of all others the gradient is exact, to the renderer, at whatever values these have.

    Args:
        inner: what renders the scene.
        constant: keys of the parameters whose derivatives are 0.
    """

    constant: frozenset[str]

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        """See `Renderer.prepare`."""
        wanted = differentiated(keys, derivatives) - self.constant
        return _PartialSession(self.inner.prepare(keys, space, wanted), self.constant)

    def with_differential_bsdf(self) -> PartialDerivatives:
        """See `DifferentialBsdfRenderer`. Raises `InputError` where the inner renderer is none."""
        return replace(self, inner=with_differential_bsdf(self.inner))


class _PartialSession:
    """See `PartialDerivatives`."""

    def __init__(self, inner: RenderSession, constant: frozenset[str]):
        self._inner, self._constant = inner, constant

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """See `RenderSession.image`."""
        return self._inner.image(parameters, request)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        """See `RenderSession.image_batch`."""
        return self._inner.image_batch(parameters, request)

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """See `RenderSession.image_pair`."""
        return self._inner.image_pair(current, previous, request, space)

    def adjoint(self, parameters: Tree, paths: Any, weights: Array) -> Tree:
        """See `RenderSession.adjoint`."""
        return self._completed(self._inner.adjoint(parameters, paths, weights), parameters)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Any, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        """See `RenderSession.adjoint_pair`."""
        found = self._inner.adjoint_pair(current, previous, paths, weights, weights_previous)
        return self._completed(found[0], current), self._completed(found[1], previous)

    def tangent_moment(self, parameters: Tree, paths: Any, tangents: Tree) -> Array:
        """See `RenderSession.tangent_moment`."""
        zeroed = {k: arrays.zeros_like(x) if k in self._constant else x for k, x in tangents.items()}
        return self._inner.tangent_moment(parameters, paths, zeroed)

    def vertices(self, parameters: Tree, request: SampleRequest) -> Array:
        """See `CountingSession.vertices`: ones where the inner session does not count."""
        return counted_vertices(self._inner, parameters, request)

    def emitters(self) -> np.ndarray:
        """See `EmitterSession.emitters`."""
        return drawing_emitters(self._inner).emitters()

    def emitter_moments(
        self, parameters: Tree, paths: Any, tangents: Tree, weights: Array, noise: Array
    ) -> EmitterMoments:
        """See `EmitterSession.emitter_moments`."""
        zeroed = {k: arrays.zeros_like(x) if k in self._constant else x for k, x in tangents.items()}
        return drawing_emitters(self._inner).emitter_moments(parameters, paths, zeroed, weights, noise)

    def _completed(self, gradient: Tree, parameters: Tree) -> Tree:
        return {key: arrays.zeros_like(x) if key in self._constant else gradient[key] for key, x in parameters.items()}


@dataclass(frozen=True, eq=False)
class HeldParameters(_View):
    """A renderer of the scene with some parameters at given values: what renders others at many values, and differentiates nothing.

    Args:
        inner: what renders the scene.
        held: {key: array} of the parameters that do not change.
    """

    held: Tree

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        """See `Renderer.prepare`."""
        everything = [*keys, *(key for key in self.held if key not in keys)]
        wanted = differentiated(keys, derivatives)
        session = self.inner.prepare(everything, space, wanted)
        return _HeldSession(_PartialSession(session, frozenset(self.held)), self.held)


class _HeldSession:
    """See `HeldParameters`."""

    def __init__(self, inner: _PartialSession, held: Tree):
        self._inner, self._held = inner, held

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """See `RenderSession.image`."""
        return self._inner.image({**self._held, **parameters}, request)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        """See `RenderSession.image_batch`."""
        count = len(next(iter(parameters.values())))
        held = {key: np.broadcast_to(x, (count, *x.shape)) for key, x in trees.numpy(self._held).items()}
        return self._inner.image_batch({**held, **parameters}, request)

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """See `RenderSession.image_pair`."""
        return self._inner.image_pair({**self._held, **current}, {**self._held, **previous}, request, space)

    def adjoint(self, parameters: Tree, paths: Any, weights: Array) -> Tree:
        """See `RenderSession.adjoint`."""
        return self._own(self._inner.adjoint({**self._held, **parameters}, paths, weights), parameters)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Any, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        """See `RenderSession.adjoint_pair`."""
        states = {**self._held, **current}, {**self._held, **previous}
        found = self._inner.adjoint_pair(*states, paths, weights, weights_previous)
        return self._own(found[0], current), self._own(found[1], previous)

    def tangent_moment(self, parameters: Tree, paths: Any, tangents: Tree) -> Array:
        """See `RenderSession.tangent_moment`."""
        everything = {**trees.zeros_like(self._held), **tangents}
        return self._inner.tangent_moment({**self._held, **parameters}, paths, everything)

    @staticmethod
    def _own(gradient: Tree, parameters: Tree) -> Tree:
        return {key: gradient[key] for key in parameters}
