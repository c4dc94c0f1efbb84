"""Exposure and white balance of each photograph as a parameter of a renderer."""

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

    Attributes:
        notices: of the inner renderer.
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
        del like
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
        del values
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
