"""Pixel weights of an adjoint pass, split by view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.rendering.renderer import SampleRequest


@dataclass(frozen=True)
class ViewWeights:
    """Pixels of one sensor.

    Attributes:
        sensor: index of the sensor.
        image: `mi.TensorXf` (H, W, 3), derivative of the loss by each element of the image; 0 at pixels that were not requested.
        pixels: `mi.UInt32`, flat indices of the requested pixels; one may occur twice.
        values: `mi.Float` (3 N,), weights of these pixels, mean over groups.
        rows: `mi.UInt32`, indices of these pixels in the request.
        spp: samples per pixel.
    """

    sensor: int
    image: Any
    pixels: Any
    values: Any
    rows: Any
    spp: int

    @property
    def samples(self) -> int:
        """Number of samples of all its pixels."""
        return dr.width(self.pixels) * self.spp


def views_of(
    request: SampleRequest, weights: mi.TensorXf, resolutions: Sequence[tuple[int, int]]
) -> Iterator[ViewWeights]:
    """Yield the views that a request has pixels of.

    Args:
        request: request of the rendering.
        weights: weights of `RenderSession.adjoint`, which are averaged over groups.
        resolutions: (height, width) of each sensor's film.
    """
    groups = weights.shape[0]
    size = dr.width(weights.array) // groups
    lane = dr.arange(mi.UInt32, size)
    mean = mi.Float(0)
    for group in range(groups):
        mean += dr.gather(mi.Float, weights.array, lane + group * size)
    mean /= groups
    dr.eval(mean)
    if request.pixels is None:
        shape = (*resolutions[request.sensor], 3)
        pixels = dr.arange(mi.UInt32, size // 3)
        yield ViewWeights(request.sensor, mi.TensorXf(mean, shape), pixels, mean, pixels, request.spp)
        return
    which = np.full(size // 3, request.sensor) if request.sensors is None else np.array(request.sensors)
    for sensor in np.unique(which).tolist():
        height, width = resolutions[sensor]
        own = mi.UInt32(np.flatnonzero(which == sensor).astype(np.uint32))
        pixels = dr.gather(mi.UInt32, request.pixels, own)
        element = dr.arange(mi.UInt32, 3 * dr.width(own))
        values = dr.gather(mi.Float, mean, dr.gather(mi.UInt32, own, element // 3) * 3 + element % 3)
        image = dr.zeros(mi.Float, height * width * 3)
        dr.scatter_add(image, values, dr.gather(mi.UInt32, pixels, element // 3) * 3 + element % 3)
        yield ViewWeights(int(sensor), mi.TensorXf(image, (height, width, 3)), pixels, values, own, request.spp)
