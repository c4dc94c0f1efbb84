"""Exposure, white balance and vignetting of photographs as parameters of a renderer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.rendering.picture_factors import PictureFactors
from unrender.rendering.renderer import ParameterInfo, Renderer, SampleRequest

EXPOSURE = "exposure"
"""The parameter's key. No scene has it: Mitsuba's keys have a dot."""
_LN2 = math.log(2.0)


def gains(exposure: np.ndarray) -> np.ndarray:
    """Return the factors of the views' pictures, (V, 3), for exposures in stops (V, 3): 2 ** (e - mean over views of e)."""
    return np.exp2(exposure - np.mean(exposure, axis=0, keepdims=True))


class ExposedRenderer(PictureFactors):
    """A renderer whose pictures have a factor per sensor and channel: the exposure and the white balance of a photograph.

    The parameter `exposure` (V, 3) has a row for each of V sensors, in stops. The picture of row v is multiplied by

        g_v = 2 ** (e_v - mean over v of e_v),   per channel.

    The geometric mean of the factors is 1, so a common exposure of all photographs cannot replace a brighter light. An
    offset that is added to a channel of all rows changes nothing: interpret values relative to their mean.

    `PictureFactors` states the biases.

    Args:
        sensors: indices of the sensors that have a row, in the order of the rows. Pictures of other sensors do not change.
    """

    key = EXPOSURE

    def __init__(self, inner: Renderer, sensors: Sequence[int]):
        super().__init__(inner)
        self.rows = {sensor: row for row, sensor in enumerate(dict.fromkeys(sensors))}
        self._indices: dict[int, Array] = {}

    def info(self) -> ParameterInfo:
        return ParameterInfo((len(self.rows), 3))

    def places(self, request: SampleRequest) -> Array:
        """Return row indices: (N,) if each pixel has its own sensor, else (1,). A sensor without a row has the index V."""
        if request.sensors is not None:
            return arrays.gather(self._row_of_sensor, request.sensors)
        row = self.rows.get(request.sensor, len(self.rows))
        if row not in self._indices:
            self._indices[row] = arrays.like_integers(np.array([row]), self.array(np.zeros(1)))
        return self._indices[row]

    @cached_property
    def _row_of_sensor(self) -> Array:
        table = [self.rows.get(sensor, len(self.rows)) for sensor in range(len(self.resolutions()))]
        return arrays.like_integers(np.array(table), self.array(np.zeros(1)))

    def factors(self, values: Array, places: Array, like: Array) -> Array:
        """Return the factors as (1, 3), or as (N, 3) if each pixel has its own sensor."""
        return arrays.exp(self._centred_rows(values, places) * _LN2)

    def factors_of_batch(self, values: np.ndarray, sensor: int) -> np.ndarray:
        """Return the factors as (n, 1, 1, 3)."""
        if sensor not in self.rows:
            return np.ones((len(values), 1, 1, 3))
        return np.stack([gains(exposure)[self.rows[sensor]] for exposure in values])[:, None, None]

    def along(self, tangent: Array, places: Array, images: Array) -> Array:
        return self._centred_rows(tangent, places) * (_LN2 * images)

    def gradient(self, values: Array, places: Array, weighted: Array) -> Array:
        """Return the gradient by the exposures, (V, 3), without its mean over rows, since the factors use centred exposures."""
        count = len(self.rows)
        parts = arrays.mean_over_first(weighted)
        parts = parts if len(arrays.shape(parts)) == 2 else arrays.sum_over_rows(parts)
        if arrays.shape(parts)[0] != arrays.shape(places)[0]:
            parts = arrays.sum_over_rows(parts)
        gradient = arrays.add_rows(parts, places, count + 1)[:count] * _LN2
        return gradient - _mean(gradient)

    @staticmethod
    def _centred_rows(exposure: Array, rows: Array) -> Array:
        """Return the centred exposures of rows; 0 for the index V."""
        centred = exposure - _mean(exposure)
        return arrays.gather_rows(arrays.concatenate([centred, centred[:1] * 0.0]), rows)


def _mean(x: Array) -> Array:
    return arrays.add_first_axis(arrays.mean_over_first(x))


VIGNETTING = "vignetting"
"""The parameter's key. No scene has it: Mitsuba's keys have a dot."""
_TERMS = 3
_LN2 = math.log(2.0)


def powers(height: int, width: int) -> np.ndarray:
    """Return r², r⁴ and r⁶ at a film's pixel centres, (H W, 3). The distance r from the film's centre is 1 at its corners."""
    y, x = np.mgrid[:height, :width] + 0.5
    square = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / ((width / 2) ** 2 + (height / 2) ** 2)
    return np.stack([square ** (k + 1) for k in range(_TERMS)], -1).reshape(-1, _TERMS)


def falloff(vignetting: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the factors of a picture's pixels, (H, W, 1): 2 ** (a₁ r² + a₂ r⁴ + a₃ r⁶)."""
    return np.exp2(powers(height, width) @ vignetting).reshape(height, width, 1)


class VignettedRenderer(PictureFactors):
    """A renderer whose pictures darken towards their corners equally in all views: the vignetting of a capture's lens.

    The parameter `vignetting` (3,) holds a₁, a₂ and a₃, in stops. A pixel at the distance r from the film's centre, 1
    at the corners, is multiplied by

        2 ** (a₁ r² + a₂ r⁴ + a₃ r⁶),   the same for all channels and sensors.

    The factor at the centre is 1, so vignetting cannot represent a common brightness of all photographs.

    `PictureFactors` states the biases.
    """

    key = VIGNETTING

    def __init__(self, inner: Renderer):
        super().__init__(inner)
        self._powers: dict[tuple[int, int], Array] = {}
        self._all: tuple[Array, Array] | None = None

    def info(self) -> ParameterInfo:
        return ParameterInfo((_TERMS,))

    def places(self, request: SampleRequest) -> Array:
        """Return r², r⁴ and r⁶ of the chosen pixels, (N, 3), or of all pixels of the film, (H W, 3)."""
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
        """Return the powers of all distinct film sizes, concatenated, and the index of each sensor's first row."""
        if self._all is None:
            sizes = list(dict.fromkeys(self.resolutions()))
            first = dict(zip(sizes, np.cumsum([0, *(h * w for h, w in sizes[:-1])]), strict=True))
            starts = np.array([first[size] for size in self.resolutions()])
            table = self.array(np.concatenate([powers(*size) for size in sizes]))
            self._all = table, arrays.like_integers(starts, self.array(np.zeros(1)))
        return self._all

    def factors(self, values: Array, places: Array, like: Array) -> Array:
        """Return the factors as (H, W, 1) or (N, 1)."""
        return _pixel_columns(arrays.exp(_stops(values, places) * _LN2), like)

    def factors_of_batch(self, values: np.ndarray, sensor: int) -> np.ndarray:
        """Return the factors as (n, H, W, 1)."""
        size = self.resolutions()[sensor]
        return np.stack([falloff(one, *size) for one in values])

    def along(self, tangent: Array, places: Array, images: Array) -> Array:
        return _pixel_columns(_stops(tangent, places), images) * (_LN2 * images)

    def gradient(self, values: Array, places: Array, weighted: Array) -> Array:
        """Return ln 2 times the sum over pixels and channels of `weighted` times the power of r, (3,)."""
        parts = arrays.mean_over_first(weighted)
        of_pixels = arrays.sum_over_last(arrays.reshape(parts, (arrays.shape(places)[0], 3)))
        return arrays.reshape(arrays.sum_over_rows(places * of_pixels), (_TERMS,)) * _LN2


def _stops(vignetting: Array, powers_: Array) -> Array:
    """Return a₁ r² + a₂ r⁴ + a₃ r⁶ of pixels, (N, 1)."""
    return arrays.sum_over_last(powers_ * arrays.add_first_axis(vignetting))


def _pixel_columns(values: Array, like: Array) -> Array:
    """Reshape values of pixels, (N, 1), to the pixel axes of images such as `like`: (H, W, 1) or (N, 1)."""
    shape = arrays.shape(like)
    sides = shape[-3:-1] if len(shape) > 2 and shape[-2] * shape[-3] == arrays.shape(values)[0] else shape[-2:-1]
    return arrays.reshape(values, (*sides, 1))
