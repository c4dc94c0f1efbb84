"""Renderers with one parameter more than the scene's: any such, those where it acts on each pixel, those where it multiplies."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.renderer import (
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
    """A renderer with one parameter more than the one inside it, 0 at first.

    Args:
        inner: what renders the scene.

    Attributes:
        key: of the parameter. No scene has it: Mitsuba's keys have a dot.
    """

    key: ClassVar[str]

    def info(self) -> ParameterInfo:
        """Return what the renderer says of the parameter."""
        raise NotImplementedError

    def parameters(self) -> Mapping[str, ParameterInfo]:
        return {**self.inner.parameters(), self.key: self.info()}

    def values(self, keys: list[str]) -> Tree:
        found = self.inner.values([key for key in keys if key != self.key])
        nothing = self.array(np.zeros(self.info().shape, np.float32))
        return {key: nothing if key == self.key else found[key] for key in keys}


class PictureRenderer(WithParameter):
    """A renderer whose parameter acts on each pixel of the pictures by itself."""

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        own = [key for key in keys if key != self.key]
        inner = self.inner.prepare(own, space, differentiated(own, derivatives))
        return inner if len(own) == len(keys) else self.session(inner)

    def session(self, inner: RenderSession) -> RenderSession:
        """Of both the parameter and those of a session."""
        raise NotImplementedError


@dataclass(frozen=True)
class PicturePaths:
    """What `adjoint` needs to walk the paths of a rendering again.

    Attributes:
        inner: of the inner renderer.
        images, previous: of the inner renderer, as in `Rendering`.
        places: what the parameter's effect on the pixels depends on beside images and parameter; None for nothing.
    """

    inner: object
    images: Array
    previous: Array | None = None
    places: Any = None


_Renderer = TypeVar("_Renderer", bound=PictureRenderer)


class PictureSession(SessionWrapper, Generic[_Renderer]):
    """Images and derivatives with respect to what acts on each pixel and to the parameters of a session. See `RenderSession`."""

    def __init__(self, renderer: _Renderer, inner: RenderSession):
        super().__init__(inner)
        self._renderer = renderer

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        found = self._inner.image(self._state(parameters), request)
        places = self._places(request)
        images = self._seen(parameters, places, found.images)
        return Rendering(images, None, PicturePaths(found.paths, found.images, None, places))

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        found = self._inner.image_pair(self._state(current), self._state(previous), request, space)
        if found.previous is None:
            raise InputError(f"{self._renderer.key}: the renderer returned one image of the two")
        places = self._places(request)
        images = self._seen(current, places, found.images)
        before = self._seen(previous, places, found.previous)
        return Rendering(images, before, PicturePaths(found.paths, found.images, found.previous, places))

    def adjoint(self, parameters: Tree, paths: PicturePaths, weights: Array) -> Tree:
        weighted, own = self._pulled_back(parameters, paths.places, paths.images, weights)
        scene = self._state(parameters)
        found = self._inner.adjoint(scene, paths.inner, weighted) if scene else {}
        return self._ordered(parameters, found, own)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: PicturePaths, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        now, own = self._pulled_back(current, paths.places, paths.images, weights)
        before, own_before = self._pulled_back(previous, paths.places, paths.previous, weights_previous)
        states = self._state(current), self._state(previous)
        found = self._inner.adjoint_pair(*states, paths.inner, now, before) if states[0] else ({}, {})
        return self._ordered(current, found[0], own), self._ordered(previous, found[1], own_before)

    def emitter_moments(
        self, parameters: Tree, paths: PicturePaths, tangents: Tree, weights: Array, noise: Array
    ) -> EmitterMoments:
        """See `EmitterSession.emitter_moments`, for the derivatives by the scene's parameters alone."""
        inner, scene = drawing_emitters(self._inner), self._state(parameters)
        if not scene:
            zeros = inner.emitters() * 0.0
            return EmitterMoments(zeros, zeros)
        slopes = self._slopes(parameters, paths.places, paths.images, weights)
        return inner.emitter_moments(scene, paths.inner, self._state(tangents), weights * slopes, noise * slopes)

    def _places(self, request: SampleRequest) -> Any:
        """See `PicturePaths.places`."""
        del request

    def _seen(self, parameters: Tree, places: Any, images: Array) -> Array:
        """What the parameter makes of images."""
        raise NotImplementedError

    def _slopes(self, parameters: Tree, places: Any, images: Array, weights: Array) -> Array:
        """The derivatives of what is shown by images, to multiply weights such as these."""
        raise NotImplementedError

    def _pulled_back(self, parameters: Tree, places: Any, images: Any, weights: Array) -> tuple[Array, Array]:
        """The weights of the images, and the derivative by the parameter, of weights of what is shown."""
        raise NotImplementedError

    def _inner_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        """The images of the inner session's `image_batch`; one for all where it has no parameters."""
        if scene := self._state(parameters):
            return self._inner.image_batch(scene, request)
        return self._inner.image({}, replace(request, groups=1)).images

    def _state(self, parameters: Tree) -> Tree:
        return {key: value for key, value in parameters.items() if key != self._renderer.key}

    def _ordered(self, parameters: Tree, found: Tree, own: Array) -> Tree:
        return {name: own if name == self._renderer.key else found[name] for name in parameters}


class PictureFactors(PictureRenderer):
    """A renderer whose pictures are multiplied, pixel by pixel, by a function of its parameter.

    Images, pairs and batches are unbiased, adjoints the exact derivative of the images that are returned. `tangent_moment` leaves out the
    products of this parameter's tangent with others, whose mean over independent signs is 0, and takes the mean of a pixel's samples for
    each: exact for one sample.
    """

    def session(self, inner: RenderSession) -> RenderSession:
        return FactorSession(self, inner)

    def places(self, request: SampleRequest) -> Array:
        """What the factors of the pixels of a rendering depend on, beside the parameter."""
        raise NotImplementedError

    def factors(self, values: Array, places: Array, like: Array) -> Array:
        """Of the parameter's values, as they multiply images such as `like`."""
        raise NotImplementedError

    def factors_of_batch(self, values: np.ndarray, sensor: int) -> np.ndarray:
        """Of n values of the parameter, first axis, for whole pictures (n, H, W, 3) or what is broadcast to them."""
        raise NotImplementedError

    def along(self, tangent: Array, places: Array, images: Array) -> Array:
        """The derivative along a tangent of the logarithms of the factors, times images."""
        raise NotImplementedError

    def gradient(self, values: Array, places: Array, weighted: Array) -> Array:
        """By the parameter, from weight times image times factor (groups, ..., 3)."""
        raise NotImplementedError


class FactorSession(PictureSession[PictureFactors]):
    """Images and derivatives with respect to what multiplies them and to the parameters of a session. See `RenderSession`."""

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        renderer = self._renderer
        factors = renderer.factors_of_batch(np.asarray(parameters[renderer.key]), request.sensor)
        return self._inner_batch(parameters, request) * renderer.array(factors)

    def tangent_moment(self, parameters: Tree, paths: PicturePaths, tangents: Tree) -> Array:
        """See `RenderSession.tangent_moment`, and `PictureFactors` for what is left out."""
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

    def _seen(self, parameters: Tree, places: Array, images: Array) -> Array:
        return images * self._factors(parameters, places, images)

    def _slopes(self, parameters: Tree, places: Array, images: Array, weights: Array) -> Array:
        del images
        return self._factors(parameters, places, weights)

    def _pulled_back(self, parameters: Tree, places: Array, images: Array, weights: Array) -> tuple[Array, Array]:
        weighted = weights * self._factors(parameters, places, weights)
        own = self._renderer.gradient(parameters[self._renderer.key], places, weighted * images)
        return weighted, own

    def _factors(self, parameters: Tree, places: Array, like: Array) -> Array:
        return self._renderer.factors(parameters[self._renderer.key], places, like)
