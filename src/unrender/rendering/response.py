"""The response curve of a capture's photographs, as a parameter beside those of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.trees import Tree
from unrender.rendering.picture_factors import PicturePaths, PictureRenderer, PictureSession
from unrender.rendering.renderer import ParameterInfo, RenderSession, SampleRequest

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


class RespondingRenderer(PictureRenderer):
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

    def session(self, inner: RenderSession) -> RenderSession:
        return RespondingSession(self, inner)


class RespondingSession(PictureSession[RespondingRenderer]):
    """Images and derivatives with respect to the response and to the parameters of a session. See `RenderSession`."""

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        values = np.asarray(parameters[RESPONSE])
        contrast, brightness = (self._renderer.array(values[:, None, None, :, k]) for k in range(2))
        return curve(contrast, brightness, self._inner_batch(parameters, request)).values

    def tangent_moment(self, parameters: Tree, paths: PicturePaths, tangents: Tree) -> Array:
        """See `RenderSession.tangent_moment`, and `RespondingRenderer` for what is left out."""
        at = _of(parameters, paths.images if arrays.shape(paths.images)[0] > 1 else paths.images[0])
        tangent = tangents[RESPONSE]
        along = at.by_contrast * tangent[:, 0] + at.by_brightness * tangent[:, 1]
        moment = along * along
        if scene := self._state(parameters):
            of_scene = self._inner.tangent_moment(scene, paths.inner, self._state(tangents))
            moment = moment + of_scene * at.slopes * at.slopes
        return moment

    def _seen(self, parameters: Tree, places: None, images: Array) -> Array:
        del places
        return _of(parameters, images).values

    def _slopes(self, parameters: Tree, places: None, images: Array, weights: Array) -> Array:
        del places, weights
        return _of(parameters, images).slopes

    def _pulled_back(self, parameters: Tree, places: None, images: Array, weights: Array) -> tuple[Array, Array]:
        """By the response: of each channel, over all pixels, the mean over groups."""
        del places
        at = _of(parameters, images)
        columns = []
        for by in (at.by_contrast, at.by_brightness):
            parts = arrays.mean_over_first(weights * by)
            flat = arrays.reshape(parts, (int(np.prod(arrays.shape(parts)[:-1])), 3))
            columns.append(arrays.reshape(arrays.sum_over_rows(flat), (3, 1)))
        first, second = (self._renderer.array(np.eye(2)[[k]]) for k in range(2))
        return weights * at.slopes, columns[0] * first + columns[1] * second


def _of(parameters: Tree, images: Array) -> Curve:
    values = parameters[RESPONSE]
    return curve(values[:, 0], values[:, 1], images)
