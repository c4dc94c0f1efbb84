"""What films store of their pixels, and a session of films that store luminance."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.mitsuba.pixel_filter import has_negative_lobes
from unrender.rendering.mitsuba.session import MitsubaSession
from unrender.rendering.renderer import EmitterMoments, PictureFormat, Rendering, SampleRequest, Space

__all__ = ["LuminanceSession", "formats"]

_COLOURS = {"y": "luminance", "ya": "luminance", "xyz": "xyz", "xyza": "xyz"}
_WEIGHTS = (0.212671, 0.715160, 0.072169)
"""Of red, green and blue in `mitsuba.luminance`."""


def formats(sensors: Sequence[Any]) -> list[PictureFormat]:
    """Of the sensors' films. Raises `InputError` where some store luminance and others colour."""
    found = []
    for sensor in sensors:
        match = re.search(r"pixel_format = (\w+)", str(sensor.film()))
        colour = _COLOURS.get(match[1] if match else "", "rgb")
        found.append(PictureFormat(colour, has_negative_lobes(sensor.film())))  # pyright: ignore[reportArgumentType]
    if len({form.colour == "luminance" for form in found}) > 1:
        raise InputError("some films have the pixel_format luminance and others colours: give all films one of both")
    return found


class LuminanceSession:
    """A session whose images have their luminance in all three channels. See `RenderSession`.

    Args:
        inner: renders RGB.
    """

    def __init__(self, inner: MitsubaSession):
        self._inner = inner

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """See `RenderSession.image`."""
        found = self._inner.image(parameters, request)
        return replace(found, images=_luminance(found.images))

    def image_batch(self, parameters: Tree, request: SampleRequest) -> mi.TensorXf:
        """See `RenderSession.image_batch`."""
        return _luminance(self._inner.image_batch(parameters, request))

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """See `RenderSession.image_pair`."""
        found = self._inner.image_pair(current, previous, request, space)
        return replace(found, images=_luminance(found.images), previous=_luminance(found.previous))

    def adjoint(self, parameters: Tree, paths: Any, weights: mi.TensorXf) -> Tree:
        """See `RenderSession.adjoint`."""
        return self._inner.adjoint(parameters, paths, _pulled_back(weights))

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Any, weights: mi.TensorXf, weights_previous: mi.TensorXf
    ) -> tuple[Tree, Tree]:
        """See `RenderSession.adjoint_pair`."""
        both = _pulled_back(weights), _pulled_back(weights_previous)
        return self._inner.adjoint_pair(current, previous, paths, *both)

    def tangent_moment(self, parameters: Tree, paths: Any, tangents: Tree) -> mi.TensorXf:
        """See `RenderSession.tangent_moment`."""
        return self._inner.tangent_moment(parameters, paths, tangents, _WEIGHTS)

    def emitters(self) -> np.ndarray:
        """See `EmitterSession.emitters`."""
        return self._inner.emitters()

    def emitter_moments(
        self, parameters: Tree, paths: Any, tangents: Tree, weights: mi.TensorXf, noise: mi.TensorXf
    ) -> EmitterMoments:
        """See `EmitterSession.emitter_moments`; the noise is that of the inner session's channels."""
        return self._inner.emitter_moments(parameters, paths, tangents, _pulled_back(weights), noise)

    def vertices(self, parameters: Tree, request: SampleRequest) -> mi.TensorXf:
        """See `CountingSession.vertices`."""
        return self._inner.vertices(parameters, request)


def _luminance(images: Any) -> mi.TensorXf:
    """(..., 3), each channel the weighted sum of all."""
    flat = images.array
    pixel = dr.arange(mi.UInt32, dr.width(flat)) // 3 * 3
    found = mi.Float(0)
    for channel, weight in enumerate(_WEIGHTS):
        found += weight * dr.gather(mi.Float, flat, pixel + channel)
    return mi.TensorXf(found, images.shape)


def _pulled_back(weights: Any) -> mi.TensorXf:
    """The transposed map, of derivatives by the luminances to derivatives by RGB."""
    flat = weights.array
    element = dr.arange(mi.UInt32, dr.width(flat))
    channel = element % 3
    total = mi.Float(0)
    for other in range(3):
        total += dr.gather(mi.Float, flat, element - channel + other)
    factor = dr.gather(mi.Float, mi.Float(list(_WEIGHTS)), channel)
    return mi.TensorXf(total * factor, weights.shape)
