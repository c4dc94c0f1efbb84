"""Vignetting of a capture's photographs, as a parameter beside those of the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.renderer import (
    CountingSession,
    ParameterInfo,
    Renderer,
    Rendering,
    RenderSession,
    SampleRequest,
    Space,
    differentiated,
)

__all__ = ["VIGNETTING", "VignettedPaths", "VignettedRenderer", "VignettedSession", "falloff", "powers"]

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


class VignettedRenderer:
    """A renderer whose pictures are darker towards their corners, all in the same way: the lens of a capture.

    The parameter `vignetting` (3,) holds a₁, a₂ and a₃, in stops: a pixel at the distance r from the middle of its film, 1 at the corners,
    is multiplied by

        2 ** (a₁ r² + a₂ r⁴ + a₃ r⁶),   the same for all channels and sensors.

    The middle is as it is, so no brightness of all photographs can hide in it.

    Images, pairs and batches are unbiased, adjoints the exact derivative of the images that are returned. `tangent_moment` leaves out the
    products of this parameter's tangent with others, whose mean over independent signs is 0, and takes the mean of a pixel's samples for
    each: exact for one sample.

    Args:
        inner: what renders the scene.

    Attributes:
        notices: of the inner renderer.
    """

    def __init__(self, inner: Renderer):
        self.inner = inner
        self.notices = tuple(getattr(inner, "notices", ()))
        self._powers: dict[tuple[int, int], Array] = {}
        self._all: tuple[Array, Array] | None = None

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """See `Renderer.parameters`."""
        return {**self.inner.parameters(), VIGNETTING: ParameterInfo((_TERMS,))}

    def values(self, keys: list[str]) -> Tree:
        """See `Renderer.values`. Vignetting is 0."""
        found = self.inner.values([key for key in keys if key != VIGNETTING])
        nothing = self.array(np.zeros(_TERMS, np.float32))
        return {key: nothing if key == VIGNETTING else found[key] for key in keys}

    def resolutions(self) -> list[tuple[int, int]]:
        """See `Renderer.resolutions`."""
        return self.inner.resolutions()

    def array(self, values: np.ndarray) -> Array:
        """See `Renderer.array`."""
        return self.inner.array(values)

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        """See `Renderer.prepare`."""
        own = [key for key in keys if key != VIGNETTING]
        session = self.inner.prepare(own, space, differentiated(own, derivatives))
        return session if len(own) == len(keys) else VignettedSession(self, session)

    def powers_of(self, request: SampleRequest) -> Array:
        """r², r⁴ and r⁶ of the chosen pixels, (N, 3), or of all of the film, (H W, 3)."""
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


@dataclass(frozen=True)
class VignettedPaths:
    """What `adjoint` needs to walk the paths of a rendering again.

    Attributes:
        inner: of the inner renderer.
        powers: of its pixels, (N, 3).
        images, previous: before the vignetting, as in `Rendering`.
    """

    inner: object
    powers: Array
    images: Array
    previous: Array | None = None


class VignettedSession:
    """Images and derivatives with respect to the vignetting and to the parameters of a session. See `RenderSession`."""

    def __init__(self, renderer: VignettedRenderer, inner: RenderSession):
        self._renderer, self._inner = renderer, inner

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """See `RenderSession.image`."""
        found = self._inner.image(_scene(parameters), request)
        powers_ = self._renderer.powers_of(request)
        images = found.images * _factors(parameters, powers_, found.images)
        return Rendering(images, None, VignettedPaths(found.paths, powers_, found.images))

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        """See `RenderSession.image_batch`."""
        size = self._renderer.resolutions()[request.sensor]
        factors = np.stack([falloff(one, *size) for one in np.asarray(parameters[VIGNETTING])])
        if scene := _scene(parameters):
            images = self._inner.image_batch(scene, request)
        else:
            images = self._inner.image({}, replace(request, groups=1)).images
        return images * self._renderer.array(factors)

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """See `RenderSession.image_pair`."""
        found = self._inner.image_pair(_scene(current), _scene(previous), request, space)
        if found.previous is None:
            raise InputError("vignetting: the renderer returned one image of the two")
        powers_ = self._renderer.powers_of(request)
        images = (
            found.images * _factors(current, powers_, found.images),
            found.previous * _factors(previous, powers_, found.previous),
        )
        return Rendering(*images, VignettedPaths(found.paths, powers_, found.images, found.previous))

    def adjoint(self, parameters: Tree, paths: VignettedPaths, weights: Array) -> Tree:
        """See `RenderSession.adjoint`."""
        weighted = weights * _factors(parameters, paths.powers, weights)
        scene = _scene(parameters)
        found = self._inner.adjoint(scene, paths.inner, weighted) if scene else {}
        return _ordered(parameters, found, _gradient(paths.powers, weighted * paths.images))

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: VignettedPaths, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        """See `RenderSession.adjoint_pair`."""
        now = weights * _factors(current, paths.powers, weights)
        before = weights_previous * _factors(previous, paths.powers, weights_previous)
        states = _scene(current), _scene(previous)
        found = self._inner.adjoint_pair(*states, paths.inner, now, before) if states[0] else ({}, {})
        own, own_previous = (
            _gradient(paths.powers, now * paths.images),
            _gradient(paths.powers, before * paths.previous),
        )
        return _ordered(current, found[0], own), _ordered(previous, found[1], own_previous)

    def tangent_moment(self, parameters: Tree, paths: VignettedPaths, tangents: Tree) -> Array:
        """See `RenderSession.tangent_moment`, and `VignettedRenderer` for what is left out."""
        images = paths.images if arrays.shape(paths.images)[0] > 1 else paths.images[0]
        along = _laid(_stops(tangents[VIGNETTING], paths.powers), images) * (_LN2 * images)
        moment = along * along
        if scene := _scene(parameters):
            moment = moment + self._inner.tangent_moment(scene, paths.inner, _scene(tangents))
        factors = _factors(parameters, paths.powers, images)
        return moment * (factors * factors)

    def vertices(self, parameters: Tree, request: SampleRequest) -> Array:
        """See `CountingSession.vertices`: ones where the inner session does not count."""
        if isinstance(self._inner, CountingSession):
            return self._inner.vertices(_scene(parameters), request)
        return self._inner.image(_scene(parameters), replace(request, groups=1)).images[0] * 0.0 + 1.0


def _stops(vignetting: Array, powers_: Array) -> Array:
    """a₁ r² + a₂ r⁴ + a₃ r⁶ of pixels, (N, 1)."""
    return arrays.sum_over_last(powers_ * arrays.add_first_axis(vignetting))


def _laid(values: Array, like: Array) -> Array:
    """Of pixels, (N, 1), as images such as `like` have them: (H, W, 1) or (N, 1)."""
    shape = arrays.shape(like)
    sides = shape[-3:-1] if len(shape) > 2 and shape[-2] * shape[-3] == arrays.shape(values)[0] else shape[-2:-1]
    return arrays.reshape(values, (*sides, 1))


def _factors(parameters: Tree, powers_: Array, like: Array) -> Array:
    return _laid(arrays.exp(_stops(parameters[VIGNETTING], powers_) * _LN2), like)


def _gradient(powers_: Array, weighted: Array) -> Array:
    """From weight times image (groups, ..., 3): ln 2 times the sum over pixels and channels of weight, image and power."""
    parts = arrays.mean_over_first(weighted)
    of_pixels = arrays.sum_over_last(arrays.reshape(parts, (arrays.shape(powers_)[0], 3)))
    return arrays.reshape(arrays.sum_over_rows(powers_ * of_pixels), (_TERMS,)) * _LN2


def _scene(parameters: Tree) -> Tree:
    return {key: value for key, value in parameters.items() if key != VIGNETTING}


def _ordered(parameters: Tree, found: Tree, own: Array) -> Tree:
    return {key: own if key == VIGNETTING else found[key] for key in parameters}
