"""Response curve of a capture's photographs as a parameter of a renderer."""

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
"""Bound of the absolute values. It corresponds to exponents from 0.22 to 4.5."""
_SLANT = 1.6
"""Shoulder per unit of contrast. Contrast then increases about a radiance of 0.37, which the sRGB curve encodes as 0.64."""
_DARK = 2.0**-10  # Radiance below which curves are linear. The slope of a power at 0 is infinite or 0.


@dataclass(frozen=True)
class Curve:
    """Values f(x), slopes ∂f/∂x > 0, and ∂f/∂c and ∂f/∂d of a response curve, each of the images' shape."""

    values: Array
    slopes: Array
    by_contrast: Array
    by_brightness: Array


def curve(contrast: Array, brightness: Array, x: Array) -> Curve:
    """Evaluate a response curve and its derivatives.

        f(x) = m(x)^γ,   m(x) = e^b x / (1 + (e^b - 1) x),   γ = exp(c),   b = d + 1.6 c,   for x from 2⁻¹⁰ to 1.

    The curve is a power after a shoulder (b > 0) or a toe (b < 0): f(0) = 0 and f(1) = 1. It increases strictly for all c and d. Below 2⁻¹⁰
    it is linear towards 0. Above 1 it is linear with its slope at 1, γ e^-b. A pure power x^γ has d = -1.6 c. Powers and shoulders have
    nearly opposite effects on middle radiances. Contrast c and brightness d are nearly independent, which conditions the optimisation.

    Args:
        contrast, brightness: c and d of each channel, or of a shape that broadcasts to the images'.
        x: linear radiance.
    """
    shoulder = brightness + _SLANT * contrast
    gamma, rise = arrays.exp(contrast), arrays.exp(shoulder)
    inside = arrays.clip(x, _DARK, 1.0)
    below = 1.0 + (rise - 1.0) * inside
    moebius = rise * inside / below
    logarithm = arrays.log(inside) + shoulder - arrays.log(below)
    values = arrays.exp(gamma * logarithm)
    slopes = gamma * values / (inside * below)
    by_brightness = gamma * values * (1.0 - moebius)
    by_contrast = gamma * logarithm * values + _SLANT * by_brightness
    dark, bright = x < _DARK, x > 1.0
    low = x * (1.0 / _DARK)
    end = gamma / rise
    over = end * (x - 1.0)

    def joined(at_dark: Array, between: Array, at_bright: Array) -> Array:
        return arrays.where(dark, at_dark, arrays.where(bright, at_bright, between))

    return Curve(
        joined(low * values, values, 1.0 + over),
        joined(values * (1.0 / _DARK), slopes, end + 0.0 * x),
        joined(low * by_contrast, by_contrast, (1.0 - _SLANT) * over),
        joined(low * by_brightness, by_brightness, -over),
    )


class RespondingRenderer(PictureRenderer):
    """A renderer whose pictures are photographs that were decoded with the sRGB curve instead of their camera's response.

    A camera with the response R encodes radiance x as R(x). Decoding by the sRGB curve S gives the photograph's values S⁻¹(R(x)) = f(x).
    The parameter `response` (3, 2) holds c and d of `curve` for each channel, as natural logarithms: 0 if the camera's curve is sRGB. It is
    the outermost of the photographs' parameters, since exposure and vignetting are factors of radiance.

    Ambiguities: unknown exposures leave any response undetermined up to a power, x^γ (M. Grossberg, S. Nayar, "Determining the camera
    response from images: what is knowable?", 2003). `with_photographs` refuses this case. If each point has the same radiance in all
    photographs (diffuse surfaces, constant light), the response is not distinguishable from a change of reflectance.

    Pictures are the curve of noisy pixels. Their bias is f''(x) / 2 times the pixel's variance, to second order, and decreases with the
    samples. Adjoints are the exact derivatives of the returned images. `tangent_moment` evaluates the slope at the mean of a pixel's
    samples and omits the products of this parameter's tangent with others. It is exact for one sample.

    Args:
        inner: renderer of the scene, including exposure.
    """

    key = RESPONSE

    def info(self) -> ParameterInfo:
        return ParameterInfo((3, 2), lowest=-RESPONSE_BOUND, highest=RESPONSE_BOUND)

    def session(self, inner: RenderSession) -> RenderSession:
        return RespondingSession(self, inner)


class RespondingSession(PictureSession[RespondingRenderer]):
    """A session that renders and differentiates with respect to the response and the inner session's parameters."""

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        values = np.asarray(parameters[RESPONSE])
        contrast, brightness = (self._renderer.array(values[:, None, None, :, k]) for k in range(2))
        return curve(contrast, brightness, self._inner_batch(parameters, request)).values

    def tangent_moment(self, parameters: Tree, paths: PicturePaths, tangents: Tree) -> Array:
        at = _curve_at(parameters, paths.images if arrays.shape(paths.images)[0] > 1 else paths.images[0])
        tangent = tangents[RESPONSE]
        along = at.by_contrast * tangent[:, 0] + at.by_brightness * tangent[:, 1]
        moment = along * along
        if scene := self._state(parameters):
            of_scene = self._inner.tangent_moment(scene, paths.inner, self._state(tangents))
            moment = moment + of_scene * at.slopes * at.slopes
        return moment

    def _outer_images(self, parameters: Tree, places: None, images: Array) -> Array:
        return _curve_at(parameters, images).values

    def _slopes(self, parameters: Tree, places: None, images: Array, weights: Array) -> Array:
        return _curve_at(parameters, images).slopes

    def _pull_back(self, parameters: Tree, places: None, images: Array, weights: Array) -> tuple[Array, Array]:
        """Return the weights of the inner images, and the gradient by the response (3, 2): the sum over pixels, the mean over groups."""
        at = _curve_at(parameters, images)
        columns = []
        for by in (at.by_contrast, at.by_brightness):
            parts = arrays.mean_over_first(weights * by)
            flat = arrays.reshape(parts, (int(np.prod(arrays.shape(parts)[:-1])), 3))
            columns.append(arrays.reshape(arrays.sum_over_rows(flat), (3, 1)))
        first, second = (self._renderer.array(np.eye(2)[[k]]) for k in range(2))
        return weights * at.slopes, columns[0] * first + columns[1] * second


def _curve_at(parameters: Tree, images: Array) -> Curve:
    values = parameters[RESPONSE]
    return curve(values[:, 0], values[:, 1], images)
