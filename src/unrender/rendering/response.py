"""The response curve of a capture's photographs, as a parameter beside those of the scene."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.picture_factors import WithParameter
from unrender.rendering.renderer import (
    EmitterMoments,
    ParameterInfo,
    Rendering,
    RenderSession,
    SampleRequest,
    Space,
    counted_vertices,
    differentiated,
    drawing_emitters,
)

__all__ = ["RESPONSE", "RESPONSE_BOUND", "Curve", "RespondingRenderer", "curve"]

RESPONSE = "response"
"""The parameter's key. No scene has it: Mitsuba's keys have a dot."""
RESPONSE_BOUND = 1.5
"""Of the absolute values: exponents from 0.22 to 4.5."""
_SLANT = 1.6
"""Shoulder that goes with a power: more contrast about a radiance of 0.37, which is half way to white as displayed."""
_DARK = 2.0**-10
"""Below, curves are straight: a power has no end of slope, or none, at 0."""


@dataclass(frozen=True)
class Curve:
    """What `curve` finds, each of the images' shape.

    Attributes:
        values: f(x).
        slopes: ∂f/∂x, > 0.
        by_contrast, by_brightness: ∂f/∂c and ∂f/∂d.
    """

    values: Array
    slopes: Array
    by_contrast: Array
    by_brightness: Array


def curve(contrast: Array, brightness: Array, x: Array) -> Curve:
    """The curve of a response and its derivatives.

        f(x) = m(x)^γ,   m(x) = e^b x / (1 + (e^b - 1) x),   γ = exp(c),   b = d + 1.6 c,   for x from 2⁻¹⁰ to 1,

    a power after a shoulder (b > 0) or a toe (b < 0): f(0) = 0 and f(1) = 1, strictly increasing for all c and d. Below 2⁻¹⁰ and above 1 it
    goes on straight, towards 0 and with the slope γ e^-b that it has at 1. A power alone, x^γ, has d = -1.6 c. Powers and shoulders do
    nearly the opposite to middle radiances; contrast c and brightness d do different things, so a descent has no valley to follow.

    Args:
        contrast, brightness: c and d, of each channel, or of a shape that broadcasts to the images'.
        x: linear radiance.
    """
    shoulder = brightness + _SLANT * contrast
    gamma, rise = arrays.exp(contrast), arrays.exp(shoulder)
    inside = arrays.clip(x, _DARK, 1.0)
    below = 1.0 + (rise - 1.0) * inside
    moebius = rise * inside / below
    logarithm = arrays.log(inside) + shoulder - arrays.log(below)
    found = arrays.exp(gamma * logarithm)
    slopes = gamma * found / (inside * below)
    by_brightness = gamma * found * (1.0 - moebius)
    by_contrast = gamma * logarithm * found + _SLANT * by_brightness
    dark, bright = x < _DARK, x > 1.0
    low = x * (1.0 / _DARK)
    end = gamma / rise
    over = end * (x - 1.0)

    def joined(at_dark: Array, between: Array, at_bright: Array) -> Array:
        return arrays.where(dark, at_dark, arrays.where(bright, at_bright, between))

    return Curve(
        joined(low * found, found, 1.0 + over),
        joined(found * (1.0 / _DARK), slopes, end + 0.0 * x),
        joined(low * by_contrast, by_contrast, (1.0 - _SLANT) * over),
        joined(low * by_brightness, by_brightness, -over),
    )


class RespondingRenderer(WithParameter):
    """A renderer whose pictures are as photographs show them that were decoded with another curve than their camera's.

    A camera with the response R encodes radiance x as R(x), which is decoded by the sRGB curve S: the photograph's values are
    S⁻¹(R(x)) = f(x). The parameter `response` (3, 2) holds c and d of `curve` for each channel, as natural logarithms: 0 where the camera's
    curve is sRGB. It is the outermost of what photographs have: exposure and vignetting are factors of radiance.

    What is not known: unknown exposures leave any response undetermined up to a power, x^γ (M. Grossberg, S. Nayar, "Determining the camera
    response from images: what is knowable?", 2003); and where each point has one radiance in all photographs, as matt surfaces have under
    light that stands still, any curve can be the colour's. `with_photographs` refuses the former.

    Pictures are the curve of noisy pixels: biased by f''(x) / 2 times the pixel's variance, to second order, which falls with the samples.
    Adjoints are the exact derivative of the images that are returned. `tangent_moment` takes the mean of a pixel's samples as where the
    slope is, and leaves out the products of this parameter's tangent with others: exact for one sample.

    Args:
        inner: what renders the scene, exposed.

    Attributes:
        notices: of the inner renderer.
    """

    key = RESPONSE

    def info(self) -> ParameterInfo:
        """See `WithParameter.info`: (3, 2), within `RESPONSE_BOUND`."""
        return ParameterInfo((3, 2), lowest=-RESPONSE_BOUND, highest=RESPONSE_BOUND)

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        """See `Renderer.prepare`."""
        own = [key for key in keys if key != self.key]
        session = self.inner.prepare(own, space, differentiated(own, derivatives))
        return session if len(own) == len(keys) else RespondingSession(self, session)


@dataclass(frozen=True)
class RespondingPaths:
    """What `adjoint` needs to walk the paths of a rendering again.

    Attributes:
        inner: of the inner renderer.
        images, previous: radiance, as in `Rendering`.
    """

    inner: object
    images: Array
    previous: Array | None = None


class RespondingSession:
    """Images and derivatives with respect to the response and to the parameters of a session. See `RenderSession`."""

    def __init__(self, renderer: RespondingRenderer, inner: RenderSession):
        self._renderer, self._inner = renderer, inner

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """See `RenderSession.image`."""
        found = self._inner.image(_scene(parameters), request)
        images = _of(parameters, found.images).values
        return Rendering(images, None, RespondingPaths(found.paths, found.images))

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        """See `RenderSession.image_batch`."""
        if scene := _scene(parameters):
            images = self._inner.image_batch(scene, request)
        else:
            images = self._inner.image({}, replace(request, groups=1)).images
        values = np.asarray(parameters[RESPONSE])
        contrast, brightness = (self._renderer.array(values[:, None, None, :, k]) for k in range(2))
        return curve(contrast, brightness, images).values

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """See `RenderSession.image_pair`."""
        found = self._inner.image_pair(_scene(current), _scene(previous), request, space)
        if found.previous is None:
            raise InputError(f"{RESPONSE}: the renderer returned one image of the two")
        images, before = _of(current, found.images).values, _of(previous, found.previous).values
        return Rendering(images, before, RespondingPaths(found.paths, found.images, found.previous))

    def adjoint(self, parameters: Tree, paths: RespondingPaths, weights: Array) -> Tree:
        """See `RenderSession.adjoint`."""
        at = _of(parameters, paths.images)
        scene = _scene(parameters)
        found = self._inner.adjoint(scene, paths.inner, weights * at.slopes) if scene else {}
        return self._ordered(parameters, found, at, weights)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: RespondingPaths, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        """See `RenderSession.adjoint_pair`."""
        now, before = _of(current, paths.images), _of(previous, paths.previous)
        states = _scene(current), _scene(previous)
        found: tuple[Tree, Tree] = ({}, {})
        if states[0]:
            weighted = weights * now.slopes, weights_previous * before.slopes
            found = self._inner.adjoint_pair(*states, paths.inner, *weighted)
        return (
            self._ordered(current, found[0], now, weights),
            self._ordered(previous, found[1], before, weights_previous),
        )

    def tangent_moment(self, parameters: Tree, paths: RespondingPaths, tangents: Tree) -> Array:
        """See `RenderSession.tangent_moment`, and `RespondingRenderer` for what is left out."""
        at = _of(parameters, paths.images if arrays.shape(paths.images)[0] > 1 else paths.images[0])
        tangent = tangents[RESPONSE]
        along = at.by_contrast * tangent[:, 0] + at.by_brightness * tangent[:, 1]
        moment = along * along
        if scene := _scene(parameters):
            moment = moment + self._inner.tangent_moment(scene, paths.inner, _scene(tangents)) * at.slopes * at.slopes
        return moment

    def vertices(self, parameters: Tree, request: SampleRequest) -> Array:
        """See `CountingSession.vertices`: ones where the inner session does not count."""
        return counted_vertices(self._inner, _scene(parameters), request)

    def emitters(self) -> np.ndarray:
        """See `EmitterSession.emitters`."""
        return drawing_emitters(self._inner).emitters()

    def emitter_moments(
        self, parameters: Tree, paths: RespondingPaths, tangents: Tree, weights: Array, noise: Array
    ) -> EmitterMoments:
        """See `EmitterSession.emitter_moments`, for the derivatives by the scene's parameters alone."""
        inner, scene = drawing_emitters(self._inner), _scene(parameters)
        if not scene:
            zeros = inner.emitters() * 0.0
            return EmitterMoments(zeros, zeros)
        slopes = _of(parameters, paths.images).slopes
        return inner.emitter_moments(scene, paths.inner, _scene(tangents), weights * slopes, noise * slopes)

    def _ordered(self, parameters: Tree, found: Tree, at: Curve, weights: Array) -> Tree:
        """With the derivative by the response: of each channel, over all pixels, the mean over groups."""
        columns = []
        for by in (at.by_contrast, at.by_brightness):
            parts = arrays.mean_over_first(weights * by)
            flat = arrays.reshape(parts, (int(np.prod(arrays.shape(parts)[:-1])), 3))
            columns.append(arrays.reshape(arrays.sum_over_rows(flat), (3, 1)))
        own = columns[0] * self._first + columns[1] * self._second
        return {name: own if name == RESPONSE else found[name] for name in parameters}

    @property
    def _first(self) -> Array:
        return self._renderer.array(np.array([[1.0, 0.0]]))

    @property
    def _second(self) -> Array:
        return self._renderer.array(np.array([[0.0, 1.0]]))


def _scene(parameters: Tree) -> Tree:
    return {key: value for key, value in parameters.items() if key != RESPONSE}


def _of(parameters: Tree, images: Array) -> Curve:
    values = parameters[RESPONSE]
    return curve(values[:, 0], values[:, 1], images)
