"""Vignetting of a capture's photographs, as a parameter beside those of the scene."""

from __future__ import annotations

import math

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.rendering.picture_factors import PictureFactors
from unrender.rendering.renderer import ParameterInfo, Renderer, SampleRequest

VIGNETTING = "vignetting"
"""The parameter's key. No scene has it: Mitsuba's keys have a dot."""
_TERMS = 3
_LN2 = math.log(2.0)


def powers(height: int, width: int) -> np.ndarray:
    """r², r⁴ and r⁶ of the middles of a film's pixels, (H W, 3); r is the distance from its middle, 1 at its corners."""
    y, x = np.mgrid[:height, :width] + 0.5
    square = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / ((width / 2) ** 2 + (height / 2) ** 2)
    return np.stack([square ** (k + 1) for k in range(_TERMS)], -1).reshape(-1, _TERMS)


def falloff(vignetting: np.ndarray, height: int, width: int) -> np.ndarray:
    """The factors of a picture's pixels, (H, W, 1): 2 ** (a₁ r² + a₂ r⁴ + a₃ r⁶)."""
    return np.exp2(powers(height, width) @ vignetting).reshape(height, width, 1)


class VignettedRenderer(PictureFactors):
    """A renderer whose pictures are darker towards their corners, all in the same way: the lens of a capture.

    The parameter `vignetting` (3,) holds a₁, a₂ and a₃, in stops: a pixel at the distance r from the middle of its film, 1 at the corners,
    is multiplied by

        2 ** (a₁ r² + a₂ r⁴ + a₃ r⁶),   the same for all channels and sensors.

    The middle is as it is, so no brightness of all photographs can hide in it.

    See `PictureFactors` for biases.

    Args:
        inner: what renders the scene.

    Attributes:
        notices: of the inner renderer.
    """

    key = VIGNETTING

    def __init__(self, inner: Renderer):
        super().__init__(inner)
        self._powers: dict[tuple[int, int], Array] = {}
        self._all: tuple[Array, Array] | None = None

    def info(self) -> ParameterInfo:
        """See `WithParameter.info`: stops, (3,)."""
        return ParameterInfo((_TERMS,))

    def places(self, request: SampleRequest) -> Array:
        """See `PictureFactors.places`: r², r⁴ and r⁶ of the chosen pixels, (N, 3), or of all of the film, (H W, 3)."""
        if request.pixels is None:
            return self._film(self.resolutions()[request.sensor])
        if request.sensors is None:
            return arrays.gather_rows(self._film(self.resolutions()[request.sensor]), request.pixels)
        table, starts = self._films()
        return arrays.gather_rows(table, arrays.gather(starts, request.sensors) + request.pixels)

    def _film(self, size: tuple[int, int]) -> Array:
        if size not in self._powers:
            self._powers[size] = self.array(powers(*size))
        return self._powers[size]

    def _films(self) -> tuple[Array, Array]:
        """Those of films of all sizes that there are, and where that of each sensor begins."""
        if self._all is None:
            sizes = list(dict.fromkeys(self.resolutions()))
            first = dict(zip(sizes, np.cumsum([0, *(h * w for h, w in sizes[:-1])]), strict=True))
            starts = np.array([first[size] for size in self.resolutions()])
            table = self.array(np.concatenate([powers(*size) for size in sizes]))
            self._all = table, arrays.like_integers(starts, self.array(np.zeros(1)))
        return self._all

    def factors(self, values: Array, places: Array, like: Array) -> Array:
        """See `PictureFactors.factors`: (H, W, 1) or (N, 1)."""
        return _laid(arrays.exp(_stops(values, places) * _LN2), like)

    def factors_of_batch(self, values: np.ndarray, sensor: int) -> np.ndarray:
        """See `PictureFactors.factors_of_batch`: (n, H, W, 1)."""
        size = self.resolutions()[sensor]
        return np.stack([falloff(one, *size) for one in values])

    def along(self, tangent: Array, places: Array, images: Array) -> Array:
        return _laid(_stops(tangent, places), images) * (_LN2 * images)

    def gradient(self, values: Array, places: Array, weighted: Array) -> Array:
        """See `PictureFactors.gradient`: ln 2 times the sum over pixels and channels of weight, image and power."""
        del values
        parts = arrays.mean_over_first(weighted)
        of_pixels = arrays.sum_over_last(arrays.reshape(parts, (arrays.shape(places)[0], 3)))
        return arrays.reshape(arrays.sum_over_rows(places * of_pixels), (_TERMS,)) * _LN2


def _stops(vignetting: Array, powers_: Array) -> Array:
    """a₁ r² + a₂ r⁴ + a₃ r⁶ of pixels, (N, 1)."""
    return arrays.sum_over_last(powers_ * arrays.add_first_axis(vignetting))


def _laid(values: Array, like: Array) -> Array:
    """Of pixels, (N, 1), as images such as `like` have them: (H, W, 1) or (N, 1)."""
    shape = arrays.shape(like)
    sides = shape[-3:-1] if len(shape) > 2 and shape[-2] * shape[-3] == arrays.shape(values)[0] else shape[-2:-1]
    return arrays.reshape(values, (*sides, 1))
