"""Renderers with one additional parameter: any, one that acts on each pixel, and one that multiplies each pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.renderer import (
    Derivatives,
    EmitterMoments,
    ParameterInfo,
    Rendering,
    RenderSession,
    SampleRequest,
    Space,
    differentiated,
    drawing_emitters,
)
from unrender.rendering.wrapper import RendererWrapper, SessionWrapper


class WithParameter(RendererWrapper):
    """A renderer with one parameter more than its inner renderer. Its initial value is 0.

    Args:
        inner: renderer of the scene.

    Attributes:
        key: key of the parameter. No scene has this key: Mitsuba's keys have a dot.
    """

    key: ClassVar[str]

    def info(self) -> ParameterInfo:
        """Return the description of the parameter."""
        raise NotImplementedError

    def parameters(self) -> Mapping[str, ParameterInfo]:
        return {**self.inner.parameters(), self.key: self.info()}

    def values(self, keys: list[str]) -> Tree:
        inner_values = self.inner.values([key for key in keys if key != self.key])
        nothing = self.array(np.zeros(self.info().shape, np.float32))
        return {key: nothing if key == self.key else inner_values[key] for key in keys}


class PictureRenderer(WithParameter):
    """A renderer whose parameter acts on each pixel of the pictures independently."""

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        own = [key for key in keys if key != self.key]
        inner = self.inner.prepare(own, space, differentiated(own, derivatives))
        return inner if len(own) == len(keys) else self.session(inner)

    def session(self, inner: RenderSession) -> RenderSession:
        """Return a session for this parameter and those of the inner session."""
        raise NotImplementedError


@dataclass(frozen=True)
class PicturePaths:
    """Data that `adjoint` needs to replay the paths of a rendering: those of the inner renderer, its images, and other data per pixel."""

    inner: object
    images: Array
    previous: Array | None = None
    places: Any = None


_Renderer = TypeVar("_Renderer", bound=PictureRenderer)


class PictureSession(SessionWrapper, Generic[_Renderer]):
    """A session that renders and differentiates with respect to the picture's parameter and the inner session's parameters."""

    def __init__(self, renderer: _Renderer, inner: RenderSession):
        super().__init__(inner)
        self._renderer = renderer

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        inner = self._inner.image(self._state(parameters), request)
        places = self._places(request)
        images = self._outer_images(parameters, places, inner.images)
        return Rendering(images, None, PicturePaths(inner.paths, inner.images, None, places))

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        inner = self._inner.image_pair(self._state(current), self._state(previous), request, space)
        if inner.previous is None:
            raise InputError(f"{self._renderer.key}: the renderer returned one image of the two")
        places = self._places(request)
        images = self._outer_images(current, places, inner.images)
        before = self._outer_images(previous, places, inner.previous)
        return Rendering(images, before, PicturePaths(inner.paths, inner.images, inner.previous, places))

    def adjoint(self, parameters: Tree, paths: PicturePaths, weights: Array) -> Tree:
        weighted, own = self._pull_back(parameters, paths.places, paths.images, weights)
        scene = self._state(parameters)
        inner_gradient = self._inner.adjoint(scene, paths.inner, weighted) if scene else {}
        return self._ordered(parameters, inner_gradient, own)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: PicturePaths, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        now, own = self._pull_back(current, paths.places, paths.images, weights)
        before, own_before = self._pull_back(previous, paths.places, paths.previous, weights_previous)
        states = self._state(current), self._state(previous)
        inner_gradients = self._inner.adjoint_pair(*states, paths.inner, now, before) if states[0] else ({}, {})
        return self._ordered(current, inner_gradients[0], own), self._ordered(previous, inner_gradients[1], own_before)

    def emitter_moments(
        self, parameters: Tree, paths: PicturePaths, tangents: Tree, weights: Array, noise: Array
    ) -> EmitterMoments:
        """Return the emitter moments of the derivatives by the scene's parameters alone."""
        inner, scene = drawing_emitters(self._inner), self._state(parameters)
        if not scene:
            zeros = inner.emitters() * 0.0
            return EmitterMoments(zeros, zeros)
        slopes = self._slopes(parameters, paths.places, paths.images, weights)
        return inner.emitter_moments(scene, paths.inner, self._state(tangents), weights * slopes, noise * slopes)

    def _places(self, request: SampleRequest) -> Any:
        del request

    def _outer_images(self, parameters: Tree, places: Any, images: Array) -> Array:
        raise NotImplementedError

    def _slopes(self, parameters: Tree, places: Any, images: Array, weights: Array) -> Array:
        """Return the derivatives of the outer images by the inner ones, of a shape that broadcasts to `weights`."""
        raise NotImplementedError

    def _pull_back(self, parameters: Tree, places: Any, images: Any, weights: Array) -> tuple[Array, Array]:
        """Return the weights of the inner images, and the gradient by the parameter, for weights of the outer images."""
        raise NotImplementedError

    def _inner_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        """Return the images of the inner session's `image_batch`, or one image for all states if it has no parameters."""
        if scene := self._state(parameters):
            return self._inner.image_batch(scene, request)
        return self._inner.image({}, replace(request, groups=1)).images

    def _state(self, parameters: Tree) -> Tree:
        return {key: value for key, value in parameters.items() if key != self._renderer.key}

    def _ordered(self, parameters: Tree, inner_gradient: Tree, own: Array) -> Tree:
        return {name: own if name == self._renderer.key else inner_gradient[name] for name in parameters}


class PictureFactors(PictureRenderer):
    """A renderer whose pictures are multiplied, pixel by pixel, by a function of its parameter.

    Images, pairs and batches are unbiased. Adjoints are the exact derivatives of the returned images. `tangent_moment`
    omits the products of this parameter's tangent with others, whose mean over independent signs is 0. It replaces each
    sample by the mean of the pixel's samples, which is exact for one sample.
    """

    def session(self, inner: RenderSession) -> RenderSession:
        return FactorSession(self, inner)

    def places(self, request: SampleRequest) -> Array:
        """Return the per-pixel data, other than the parameter, that the factors of a rendering depend on."""
        raise NotImplementedError

    def factors(self, values: Array, places: Array, like: Array) -> Array:
        """Return the factors for the parameter's values, of a shape that broadcasts to images such as `like`."""
        raise NotImplementedError

    def factors_of_batch(self, values: np.ndarray, sensor: int) -> np.ndarray:
        """Return the factors for n values of the parameter, first axis, of a shape that broadcasts to full pictures (n, H, W, 3)."""
        raise NotImplementedError

    def along(self, tangent: Array, places: Array, images: Array) -> Array:
        """Return the derivative of the logarithm of the factors along a tangent, times the images."""
        raise NotImplementedError

    def gradient(self, values: Array, places: Array, weighted: Array) -> Array:
        """Return the gradient by the parameter. `weighted` is weight times image times factor, (groups, ..., 3)."""
        raise NotImplementedError


class FactorSession(PictureSession[PictureFactors]):
    """A session that renders and differentiates with respect to the factors' parameter and the inner session's parameters."""

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        renderer = self._renderer
        factors = renderer.factors_of_batch(np.asarray(parameters[renderer.key]), request.sensor)
        return self._inner_batch(parameters, request) * renderer.array(factors)

    def tangent_moment(self, parameters: Tree, paths: PicturePaths, tangents: Tree) -> Array:
        renderer = self._renderer
        images = paths.images if arrays.shape(paths.images)[0] > 1 else paths.images[0]
        along = renderer.along(tangents[renderer.key], paths.places, images)
        moment = along * along
        if scene := self._state(parameters):
            moment = moment + self._inner.tangent_moment(scene, paths.inner, self._state(tangents))
        factors = self._factors(parameters, paths.places, images)
        return moment * (factors * factors)

    def _places(self, request: SampleRequest) -> Array:
        return self._renderer.places(request)

    def _outer_images(self, parameters: Tree, places: Array, images: Array) -> Array:
        return images * self._factors(parameters, places, images)

    def _slopes(self, parameters: Tree, places: Array, images: Array, weights: Array) -> Array:
        return self._factors(parameters, places, weights)

    def _pull_back(self, parameters: Tree, places: Array, images: Array, weights: Array) -> tuple[Array, Array]:
        weighted = weights * self._factors(parameters, places, weights)
        own = self._renderer.gradient(parameters[self._renderer.key], places, weighted * images)
        return weighted, own

    def _factors(self, parameters: Tree, places: Array, like: Array) -> Array:
        return self._renderer.factors(parameters[self._renderer.key], places, like)
