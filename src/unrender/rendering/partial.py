"""Renderers that restrict another: one differentiates a subset of the parameters, the other fixes some parameters at constant values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.renderer import (
    Derivatives,
    ParameterInfo,
    Renderer,
    RenderSession,
    SampleRequest,
    Space,
    differentiated,
)
from unrender.rendering.wrapper import RendererWrapper, SessionWrapper


class PartialDerivatives(RendererWrapper):
    """A renderer that sets the derivatives of some parameters to 0.

    These parameters change and need not be differentiable. The gradient by all others is that of the inner renderer at their current
    values.
    """

    def __init__(self, inner: Renderer, constant: frozenset[str]):
        super().__init__(inner)
        self.constant = constant

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        differentiable = differentiated(keys, derivatives) - self.constant
        return _PartialSession(self.inner.prepare(keys, space, differentiable), self.constant)


class _PartialSession(SessionWrapper):
    """A session that sets the tangents and gradients of constant parameters to 0."""

    def __init__(self, inner: RenderSession, constant: frozenset[str]):
        super().__init__(inner)
        self._constant = constant

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        return {k: arrays.zeros_like(x) if k in self._constant else x for k, x in tangents.items()}

    def _gradient(self, parameters: Tree, inner_gradient: Tree, paths: Any) -> Tree:
        return {
            key: arrays.zeros_like(x) if key in self._constant else inner_gradient[key] for key, x in parameters.items()
        }


class HeldParameters(RendererWrapper):
    """A renderer of the scene with some parameters fixed at constant values. Sessions return no derivatives by them."""

    def __init__(self, inner: Renderer, held: Tree):
        super().__init__(inner)
        self.held = held

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        everything = [*keys, *(key for key in self.held if key not in keys)]
        session = self.inner.prepare(everything, space, differentiated(keys, derivatives))
        return _HeldSession(_PartialSession(session, frozenset(self.held)), self.held)


class EliminatedParameters(HeldParameters):
    """A renderer of the scene in which eliminated parameters are linear functions of those of a session.

    Args:
        held: {key: array} of the fixed parameters.
        origin: values of the session's parameters at which the fixed ones are at `held`, (n,).
        slopes: {key: change per unit of each of the n elements, (n, *shape)} of the eliminated parameters.
        bounds: {key: function from its values to the nearest values within its bounds}.
    """

    def __init__(
        self,
        inner: Renderer,
        held: Tree,
        origin: np.ndarray,
        slopes: Mapping[str, np.ndarray],
        bounds: Mapping[str, Callable[[np.ndarray], np.ndarray]],
    ):
        super().__init__(inner, held)
        self.origin, self.slopes, self.bounds = origin, slopes, bounds

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """Return every parameter. None is of one sensor, since the eliminated ones follow, which all sensors see."""
        return {key: replace(info, sensor=None) for key, info in self.inner.parameters().items()}

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        if differentiated(keys, derivatives):
            raise InputError("EliminatedParameters: only images are available, no derivatives")
        everything = [*keys, *(key for key in self.held if key not in keys)]
        return _EliminatedSession(self.inner.prepare(everything, space, derivatives=False), self)


class _HeldSession(SessionWrapper):
    """A session that adds the fixed parameters to each state and removes them from each gradient."""

    def __init__(self, inner: RenderSession, held: Tree):
        super().__init__(inner)
        self._held = held

    def _state(self, parameters: Tree) -> Tree:
        return {**self._held, **parameters}

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        return {**trees.zeros_like(self._held), **tangents}

    def _gradient(self, parameters: Tree, inner_gradient: Tree, paths: Any) -> Tree:
        return {key: inner_gradient[key] for key in parameters}

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        count = len(next(iter(parameters.values())))
        held = {key: np.broadcast_to(x, (count, *x.shape)) for key, x in trees.numpy(self._held).items()}
        return self._inner.image_batch({**held, **parameters}, request)


class _EliminatedSession(_HeldSession):
    """A session that adds the fixed and the eliminated parameters of an `EliminatedParameters` to each state."""

    def __init__(self, inner: RenderSession, renderer: EliminatedParameters):
        super().__init__(inner, renderer.held)
        self._renderer = renderer

    def _state(self, parameters: Tree) -> Tree:
        moved = self._eliminated_values({key: arrays.numpy(x)[None] for key, x in parameters.items()})
        moved = {key: arrays.like(x[0], self._held[key]) for key, x in moved.items()}
        return super()._state({**moved, **parameters})

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        return super().image_batch({**self._eliminated_values(parameters), **parameters}, request)

    def _eliminated_values(self, parameters: Tree) -> dict[str, np.ndarray]:
        """Return the values of the eliminated parameters in each state, (B, *shape); {} if all states are at the origin."""
        flat = [np.asarray(x, np.float64).reshape(len(x), -1) for x in parameters.values()]
        change = np.concatenate(flat, axis=1) - self._renderer.origin
        if not change.any():
            return {}
        moved = {
            key: (arrays.numpy(self._held[key]) + np.tensordot(change, slopes, 1)).astype(np.float32)
            for key, slopes in self._renderer.slopes.items()
            if slopes.any()
        }
        return {key: self._renderer.bounds[key](values) for key, values in moved.items()}
