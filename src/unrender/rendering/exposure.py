"""Exposure and white balance of each photograph, as a parameter beside those of the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import cached_property

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

__all__ = ["EXPOSURE", "ExposedPaths", "ExposedRenderer", "ExposedSession", "gains"]

EXPOSURE = "exposure"
"""The parameter's key. No scene has it: Mitsuba's keys have a dot."""
_LN2 = math.log(2.0)


def gains(exposure: np.ndarray) -> np.ndarray:
    """The factors of the views' pictures, (V, 3), of exposures in stops (V, 3): 2 ** (e - mean over views of e)."""
    return np.exp2(exposure - np.mean(exposure, axis=0, keepdims=True))


class ExposedRenderer:
    """A renderer whose pictures have a factor per sensor and channel: the exposure and the white balance of a photograph.

    The parameter `exposure` (V, 3) has a row for each of V sensors, in stops: the picture of row v is multiplied by

        g_v = 2 ** (e_v - mean over v of e_v),   per channel,

    so the factors have the geometric mean 1 whatever the values are, and a brighter exposure of all photographs cannot stand for a
    brighter light. Adding a number to a channel of all rows changes nothing: values are to be read without their mean.

    Images, pairs and batches are unbiased, adjoints the exact derivative of the images that are returned. `tangent_moment` leaves out
    the products of the exposure's tangent with others, whose mean over independent signs is 0, and takes the mean of a pixel's samples
    for each: exact for one sample.

    Args:
        inner: what renders the scene.
        sensors: those that have a row, in this order; the pictures of others are as they are.

    Attributes:
        notices: of the inner renderer.
    """

    def __init__(self, inner: Renderer, sensors: Sequence[int]):
        self.inner = inner
        self.rows = {sensor: row for row, sensor in enumerate(dict.fromkeys(sensors))}
        self.notices = tuple(getattr(inner, "notices", ()))
        self._indices: dict[int, Array] = {}

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """See `Renderer.parameters`."""
        return {**self.inner.parameters(), EXPOSURE: ParameterInfo((len(self.rows), 3))}

    def values(self, keys: list[str]) -> Tree:
        """See `Renderer.values`. Exposures are 0."""
        found = self.inner.values([key for key in keys if key != EXPOSURE])
        zeros = self.array(np.zeros((len(self.rows), 3), np.float32))
        return {key: zeros if key == EXPOSURE else found[key] for key in keys}

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
        own = [key for key in keys if key != EXPOSURE]
        session = self.inner.prepare(own, space, differentiated(own, derivatives))
        return session if len(own) == len(keys) else ExposedSession(self, session)

    def rows_of(self, request: SampleRequest) -> Array:
        """The row of each chosen pixel where these have sensors of their own, else of all, (1,); one behind the last for none."""
        if request.sensors is not None:
            return arrays.gather(self._of_sensors, request.sensors)
        row = self.rows.get(request.sensor, len(self.rows))
        if row not in self._indices:
            self._indices[row] = arrays.like_integers(np.array([row]), self.array(np.zeros(1)))
        return self._indices[row]

    @cached_property
    def _of_sensors(self) -> Array:
        table = [self.rows.get(sensor, len(self.rows)) for sensor in range(len(self.resolutions()))]
        return arrays.like_integers(np.array(table), self.array(np.zeros(1)))


@dataclass(frozen=True)
class ExposedPaths:
    """What `adjoint` needs to walk the paths of a rendering again.

    Attributes:
        inner: of the inner renderer.
        rows: the exposure of the picture, (1,), or of each chosen pixel, (N,).
        images, previous: before the exposure, as in `Rendering`.
    """

    inner: object
    rows: Array
    images: Array
    previous: Array | None = None


class ExposedSession:
    """Images and derivatives with respect to the exposure and to the parameters of a session. See `RenderSession`."""

    def __init__(self, renderer: ExposedRenderer, inner: RenderSession):
        self._renderer, self._inner = renderer, inner

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """See `RenderSession.image`."""
        found = self._inner.image(_scene(parameters), request)
        rows = self._renderer.rows_of(request)
        images = found.images * self._gains(parameters, rows)
        return Rendering(images, None, ExposedPaths(found.paths, rows, found.images))

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        """See `RenderSession.image_batch`."""
        exposures = np.asarray(parameters[EXPOSURE])
        factors = np.ones((len(exposures), 1, 1, 3))
        if request.sensor in self._renderer.rows:
            row = self._renderer.rows[request.sensor]
            factors = np.stack([gains(exposure)[row] for exposure in exposures])[:, None, None]
        if scene := _scene(parameters):
            images = self._inner.image_batch(scene, request)
        else:
            images = self._inner.image({}, replace(request, groups=1)).images
        return images * self._renderer.array(factors)

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """See `RenderSession.image_pair`."""
        found = self._inner.image_pair(_scene(current), _scene(previous), request, space)
        if found.previous is None:
            raise InputError("exposure: the renderer returned one image of the two")
        rows = self._renderer.rows_of(request)
        images = found.images * self._gains(current, rows), found.previous * self._gains(previous, rows)
        return Rendering(*images, ExposedPaths(found.paths, rows, found.images, found.previous))

    def adjoint(self, parameters: Tree, paths: ExposedPaths, weights: Array) -> Tree:
        """See `RenderSession.adjoint`."""
        factors = self._gains(parameters, paths.rows)
        scene = _scene(parameters)
        found = self._inner.adjoint(scene, paths.inner, weights * factors) if scene else {}
        own = self._gradient(parameters, paths.rows, weights * factors * paths.images)
        return _ordered(parameters, found, own)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: ExposedPaths, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        """See `RenderSession.adjoint_pair`."""
        now, before = weights * self._gains(current, paths.rows), weights_previous * self._gains(previous, paths.rows)
        states = _scene(current), _scene(previous)
        found = self._inner.adjoint_pair(*states, paths.inner, now, before) if states[0] else ({}, {})
        own = self._gradient(current, paths.rows, now * paths.images)
        own_previous = self._gradient(previous, paths.rows, before * paths.previous)
        return _ordered(current, found[0], own), _ordered(previous, found[1], own_previous)

    def tangent_moment(self, parameters: Tree, paths: ExposedPaths, tangents: Tree) -> Array:
        """See `RenderSession.tangent_moment`, and `ExposedRenderer` for what is left out."""
        images = paths.images if arrays.shape(paths.images)[0] > 1 else paths.images[0]
        along = self._of_rows(tangents[EXPOSURE] - _mean(tangents[EXPOSURE]), paths.rows) * (_LN2 * images)
        moment = along * along
        if scene := _scene(parameters):
            moment = moment + self._inner.tangent_moment(scene, paths.inner, _scene(tangents))
        factors = self._gains(parameters, paths.rows)
        return moment * (factors * factors)

    def vertices(self, parameters: Tree, request: SampleRequest) -> Array:
        """See `CountingSession.vertices`: ones where the inner session does not count."""
        if isinstance(self._inner, CountingSession):
            return self._inner.vertices(_scene(parameters), request)
        return self._inner.image(_scene(parameters), replace(request, groups=1)).images[0] * 0.0 + 1.0

    def _gains(self, parameters: Tree, rows: Array) -> Array:
        """(1, 3), or (N, 3)."""
        exposure = parameters[EXPOSURE]
        return arrays.exp(self._of_rows(exposure - _mean(exposure), rows) * _LN2)

    def _of_rows(self, centred: Array, rows: Array) -> Array:
        return arrays.gather_rows(arrays.concatenate([centred, centred[:1] * 0.0]), rows)

    def _gradient(self, parameters: Tree, rows: Array, weighted: Array) -> Array:
        """Of the exposures, from weight times image (groups, ..., 3): without its mean, as they enter without theirs."""
        count = len(self._renderer.rows)
        parts = arrays.mean_over_first(weighted)
        parts = parts if len(arrays.shape(parts)) == 2 else arrays.sum_over_rows(parts)
        if arrays.shape(parts)[0] != arrays.shape(rows)[0]:
            parts = arrays.sum_over_rows(parts)
        found = arrays.add_rows(parts, rows, count + 1)[:count] * _LN2
        return found - _mean(found)


def _mean(x: Array) -> Array:
    return arrays.add_first_axis(arrays.mean_over_first(x))


def _scene(parameters: Tree) -> Tree:
    return {key: value for key, value in parameters.items() if key != EXPOSURE}


def _ordered(parameters: Tree, found: Tree, own: Array) -> Tree:
    return {key: own if key == EXPOSURE else found[key] for key in parameters}
