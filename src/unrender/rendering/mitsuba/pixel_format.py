"""Pixel formats of films, and a session for films that store luminance."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.mitsuba.film_response import is_spectral
from unrender.rendering.mitsuba.path_cache.session import CachingSession
from unrender.rendering.mitsuba.pixel_filter import has_negative_lobes
from unrender.rendering.mitsuba.session import MitsubaSession
from unrender.rendering.picture_format import PictureFormat
from unrender.rendering.renderer import Rendering, SampleRequest
from unrender.rendering.wrapper import SessionWrapper

_COLOURS = {"y": "luminance", "ya": "luminance", "xyz": "xyz", "xyza": "xyz"}
_WEIGHTS = (0.212671, 0.715160, 0.072169)  # weights of red, green and blue in `mitsuba.luminance`


def formats(sensors: Sequence[Any]) -> list[PictureFormat]:
    """Return the formats of the sensors' films. Raise `InputError` if some store luminance and others colour."""
    result = []
    for sensor in sensors:
        match = re.search(r"pixel_format = (\w+)", str(sensor.film()))
        name = match[1] if match else ""
        colour, stores_alpha = _COLOURS.get(name, "rgb"), name in ("rgba", "xyza", "ya")
        # Colours of some spectra are outside sRGB, and so are samples of few wavelengths.
        signed = has_negative_lobes(sensor.film()) or is_spectral()
        result.append(PictureFormat(colour, signed, stores_alpha=stores_alpha))  # pyright: ignore[reportArgumentType]
    if len({form.colour == "luminance" for form in result}) > 1:
        raise InputError("some films have the pixel_format luminance and others store colour; give all films the same")
    return result


class LuminanceSession(SessionWrapper):
    """A session whose images have the luminance in all three channels."""

    _inner: MitsubaSession | CachingSession

    def _shown(self, rendering: Rendering, request: SampleRequest) -> Rendering:
        previous = None if rendering.previous is None else _luminance(rendering.previous)
        return replace(rendering, images=_luminance(rendering.images), previous=previous)

    def _weights(self, weights: mi.TensorXf) -> mi.TensorXf:
        return _pull_back(weights)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> mi.TensorXf:
        return _luminance(self._inner.image_batch(parameters, request))

    def tangent_moment(self, parameters: Tree, paths: Any, tangents: Tree) -> mi.TensorXf:
        return self._inner.tangent_moment(parameters, paths, tangents, _WEIGHTS)


def _luminance(images: Any) -> mi.TensorXf:
    """Return (..., 3) whose channels are the weighted sum of all channels."""
    flat = images.array
    pixel = dr.arange(mi.UInt32, dr.width(flat)) // 3 * 3
    total = mi.Float(0)
    for channel, weight in enumerate(_WEIGHTS):
        total += weight * dr.gather(mi.Float, flat, pixel + channel)
    return mi.TensorXf(total, images.shape)


def _pull_back(weights: Any) -> mi.TensorXf:
    """Return derivatives by RGB for derivatives by the luminance channels: the transpose of `_luminance`."""
    flat = weights.array
    element = dr.arange(mi.UInt32, dr.width(flat))
    channel = element % 3
    total = mi.Float(0)
    for other in range(3):
        total += dr.gather(mi.Float, flat, element - channel + other)
    factor = dr.gather(mi.Float, mi.Float(list(_WEIGHTS)), channel)
    return mi.TensorXf(total * factor, weights.shape)
