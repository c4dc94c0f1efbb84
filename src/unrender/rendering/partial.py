"""Two views of a renderer: one that differentiates some of its parameters alone, and one that holds some of them at given values."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from typing import Any

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.trees import Tree
from unrender.rendering.renderer import Renderer, RenderSession, SampleRequest, Space, differentiated
from unrender.rendering.wrapper import RendererWrapper, SessionWrapper


class PartialDerivatives(RendererWrapper):
    """A renderer that changes all parameters and differentiates all but some: the derivatives by these are returned as 0.

    They need not be differentiable: of all others the gradient is exact, to the renderer, at whatever values these have.

    Args:
        inner: what renders the scene.
        constant: keys of the parameters whose derivatives are 0.
    """

    def __init__(self, inner: Renderer, constant: frozenset[str]):
        super().__init__(inner)
        self.constant = constant

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        wanted = differentiated(keys, derivatives) - self.constant
        return _PartialSession(self.inner.prepare(keys, space, wanted), self.constant)


class _PartialSession(SessionWrapper):
    """See `PartialDerivatives`."""

    def __init__(self, inner: RenderSession, constant: frozenset[str]):
        super().__init__(inner)
        self._constant = constant

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        return {k: arrays.zeros_like(x) if k in self._constant else x for k, x in tangents.items()}

    def _gradient(self, parameters: Tree, found: Tree, paths: Any) -> Tree:
        return {key: arrays.zeros_like(x) if key in self._constant else found[key] for key, x in parameters.items()}


class HeldParameters(RendererWrapper):
    """A renderer of the scene with some parameters at given values: what renders others at many values, and differentiates nothing.

    Args:
        inner: what renders the scene.
        held: {key: array} of the parameters that do not change.
    """

    def __init__(self, inner: Renderer, held: Tree):
        super().__init__(inner)
        self.held = held

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        everything = [*keys, *(key for key in self.held if key not in keys)]
        session = self.inner.prepare(everything, space, differentiated(keys, derivatives))
        return _HeldSession(_PartialSession(session, frozenset(self.held)), self.held)


class _HeldSession(SessionWrapper):
    """See `HeldParameters`."""

    def __init__(self, inner: RenderSession, held: Tree):
        super().__init__(inner)
        self._held = held

    def _state(self, parameters: Tree) -> Tree:
        return {**self._held, **parameters}

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        return {**trees.zeros_like(self._held), **tangents}

    def _gradient(self, parameters: Tree, found: Tree, paths: Any) -> Tree:
        return {key: found[key] for key in parameters}

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        count = len(next(iter(parameters.values())))
        held = {key: np.broadcast_to(x, (count, *x.shape)) for key, x in trees.numpy(self._held).items()}
        return self._inner.image_batch({**held, **parameters}, request)
