"""A renderer whose one parameter, a field over the unit square or cube, may have any resolution; in NumPy, its gradient known."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from tests.analytic import AnalyticRenderer
from unrender.core.trees import Tree
from unrender.rendering.renderer import ParameterInfo, Rendering, SampleRequest, Space

KEY = "field"


def weights(points: np.ndarray, size: tuple[int, ...], corners: bool = False) -> np.ndarray:
    """What each texel of a field of that size counts for at points (N, axes) of the unit cube: (N, texels).

    Texels' values sit at their middles, and are constant beyond the outermost; with `corners` (another convention, a planted fault) the
    outermost sit on the border.
    """
    found = np.zeros((len(points), *size))
    place = points * (np.array(size) - 1) if corners else points * np.array(size) - 0.5
    low = np.floor(place).astype(int)
    for corner in itertools.product((0, 1), repeat=len(size)):
        index = np.clip(low + corner, 0, np.array(size) - 1)
        share = np.where(np.array(corner) == 1, place - low, 1 - (place - low)).prod(axis=1)
        np.add.at(found, (np.arange(len(points)), *index.T), share)
    return found.reshape(len(points), -1)


def middles(size: tuple[int, ...]) -> np.ndarray:
    """The middles of texels, (texels, axes)."""
    axes = np.meshgrid(*((np.arange(n) + 0.5) / n for n in size), indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=1)


def upsampled(values: np.ndarray, size: tuple[int, ...], corners: bool = False) -> np.ndarray:
    """(*coarse, C) to (*size, C), by hand."""
    matrix = weights(middles(size), values.shape[:-1], corners)
    return (matrix @ values.reshape(-1, values.shape[-1])).reshape(*size, -1)


class FieldRenderer:
    """Pixels that look at fixed points of the field, with noise in proportion to what they see.

    Args:
        values: of the field at its full resolution, (H, W, 1) or (Z, Y, X, 1).
        noise, grain: see `AnalyticRenderer`.
    """

    film = (6, 8)

    def __init__(self, values: np.ndarray, noise: float = 0.5, grain: float = 0.02):
        self.field, self.noise, self.grain = np.asarray(values, np.float64), noise, grain
        self._made: dict[tuple[int, ...], AnalyticRenderer] = {}

    @cached_property
    def points(self) -> np.ndarray:
        return np.random.default_rng(4).random((self.film[0] * self.film[1], self.field.ndim - 1))

    def at(self, shape: tuple[int, ...]) -> AnalyticRenderer:
        """The renderer of fields of that shape."""
        if shape not in self._made:
            matrix = np.repeat(weights(self.points, shape[:-1]), 3, axis=0)
            values = self.field if shape == self.field.shape else np.zeros(shape)
            self._made[shape] = AnalyticRenderer({KEY: values}, matrix, 0.1, self.noise, self.grain, self.film)
        return self._made[shape]

    def parameters(self) -> Mapping[str, ParameterInfo]:
        return {KEY: replace(self.at(self.field.shape).parameters()[KEY], resizable=True)}

    def values(self, keys: list[str]) -> Tree:
        return self.at(self.field.shape).values(keys)

    def resolutions(self) -> list[tuple[int, int]]:
        return [self.film]

    def array(self, values: np.ndarray) -> np.ndarray:
        return np.array(values, np.float64)

    def prepare(self, keys: list[str], space: Space | None, derivatives: Any = True) -> FieldRenderer:
        self.at(self.field.shape).prepare(keys, space, derivatives)
        return self

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        return self.at(parameters[KEY].shape).image(parameters, request)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> np.ndarray:
        return self.at(parameters[KEY].shape[1:]).image_batch(parameters, request)

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        assert current[KEY].shape == previous[KEY].shape
        return self.at(current[KEY].shape).image_pair(current, previous, request, space)

    def adjoint(self, parameters: Tree, paths: Any, weights: np.ndarray) -> Tree:
        return self.at(parameters[KEY].shape).adjoint(parameters, paths, weights)

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Any, weights: np.ndarray, weights_previous: np.ndarray
    ) -> tuple[Tree, Tree]:
        return self.at(current[KEY].shape).adjoint_pair(current, previous, paths, weights, weights_previous)

    def tangent_moment(self, parameters: Tree, paths: Any, tangents: Tree) -> np.ndarray:
        return self.at(parameters[KEY].shape).tangent_moment(parameters, paths, tangents)
