"""A NumPy renderer with known integrals and gradients, which tests methods without a path tracer.

Pixel p, channel c of sensor s is the integral over u in [0, 1)² of

    f(u; θ) = b_pc + a_pc · θ̄ + g(θ)_pc (2 u₁ - 1) + h_pc (2 u₂ - 1),        g(θ) = noise · (a_pc · θ̄),

where θ̄ is the concatenation of all flattened parameters in the order of the keys. The exact image is I = b + A θ̄, its
Jacobian A. Noise that scales with θ (g) and noise that does not (h) are shared between two states as in a path tracer.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.renderer import ParameterInfo, Rendering, SampleRequest, Space


@dataclass(frozen=True)
class AnalyticPaths:
    """Seed and shape of the random numbers of a rendering, with the number of groups and the chosen pixels."""

    seed: int
    shape: tuple[int, int, int, int]
    groups: int
    pixels: np.ndarray | None
    positions: np.ndarray | None

    @cached_property
    def numbers(self) -> np.ndarray:
        """(pixels, channels, spp, 2), drawn when they are first needed."""
        numbers = np.random.default_rng(self.seed).random(self.shape)
        return numbers if self.positions is None else numbers[self.positions]

    @cached_property
    def centred(self) -> np.ndarray:
        """Mean of 2 u - 1 over each group's samples, for both random numbers: (2, groups, pixels * channels)."""
        pairs = self.numbers.view(
            np.complex128
        )  # NumPy adds up pairs of numbers in a tenth of the time as complex ones
        means = pairs.reshape(-1, self.groups, self.shape[2] // self.groups).mean(axis=2)
        return 2 * means.view(np.float64).reshape(*means.shape, 2).T - 1


class AnalyticRenderer:
    """Images linear in the parameters, with multiplicative and additive noise.

    Args:
        values: {key: array}, the scene's own values.
        matrix: A, (height * width * 3, n) for n parameters in all, in the order of `values`.
        offset: b, (height, width, 3), or a number.
        noise: relative half-width of the multiplicative noise: a sample of A θ̄ varies uniformly by ± noise.
        grain: h, half-width of the additive noise, which does not depend on θ, per sample.
        shape: (height, width) of the film.
        sensors: number of identical sensors.
        shares_paths: `ParameterInfo.shares_paths` of every parameter.

    Raises:
        InputError: the matrix does not have the shape that values and film imply.
    """

    def __init__(
        self,
        values: Mapping[str, np.ndarray],
        matrix: np.ndarray,
        offset: np.ndarray | float = 0.0,
        noise: float = 0.5,
        grain: float = 0.0,
        shape: tuple[int, int] = (4, 4),
        sensors: int = 1,
        shares_paths: bool = True,
    ):
        self._values = {key: np.asarray(value, np.float64) for key, value in values.items()}
        self.matrix = np.asarray(matrix, np.float64)
        self.shape = shape
        self.offset = np.broadcast_to(np.asarray(offset, np.float64), (*shape, 3)).reshape(-1)
        self.noise, self.grain, self.sensors, self.shares_paths = noise, grain, sensors, shares_paths
        size = sum(value.size for value in self._values.values())
        if self.matrix.shape != (shape[0] * shape[1] * 3, size):
            raise InputError(f"matrix: expected shape {(shape[0] * shape[1] * 3, size)}, got {self.matrix.shape}")

    def parameters(self) -> Mapping[str, ParameterInfo]:
        return {key: ParameterInfo(value.shape, shares_paths=self.shares_paths) for key, value in self._values.items()}

    def values(self, keys: list[str]) -> Tree:
        return {key: self._values[key].copy() for key in keys}

    def resolutions(self) -> list[tuple[int, int]]:
        return [self.shape] * self.sensors

    def array(self, values: np.ndarray) -> np.ndarray:
        """Return a NumPy array in double precision."""
        return np.array(values, np.float64)

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> AnalyticRenderer:
        """Return the renderer itself, which is stateless and therefore its own session."""
        del derivatives
        for key in keys:
            if key not in self._values:
                raise InputError(f"parameter {key}: the scene has none of that name")
            if space == "path" and not self.shares_paths:
                raise InputError(f'parameter {key}: space="path" cannot share its paths; use space="primary"')
        return self

    def exact(self, parameters: Tree) -> np.ndarray:
        """Return the exact image (H, W, 3)."""
        return (self.offset + self.matrix @ self._flat(parameters)).reshape(*self.shape, 3)

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        paths = self._paths(request)
        return Rendering(self._images(parameters, paths), None, paths)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> np.ndarray:
        paths = replace(self._paths(request), groups=1)
        count = len(next(iter(parameters.values())))
        states = [{key: value[index] for key, value in parameters.items()} for index in range(count)]
        return np.concatenate([self._images(state, paths) for state in states])

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """Render two states with the same random numbers, in either space."""
        del space
        paths = self._paths(request)
        return Rendering(self._images(current, paths), self._images(previous, paths), paths)

    def adjoint(self, parameters: Tree, paths: AnalyticPaths, weights: np.ndarray) -> Tree:
        rows = self._rows(paths.pixels)
        factors = 1 + self.noise * paths.centred[0] if self.noise else 1.0
        flat = (np.asarray(weights).reshape(paths.groups, -1) * factors).mean(axis=0) @ self.matrix[rows]
        gradient, start = {}, 0
        for key, value in self._values.items():
            part = flat[start : start + value.size].reshape(value.shape)
            start += value.size
            if key in parameters:
                gradient[key] = part
        return gradient

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: AnalyticPaths, weights: np.ndarray, weights_previous: np.ndarray
    ) -> tuple[Tree, Tree]:
        return self.adjoint(current, paths, weights), self.adjoint(previous, paths, weights_previous)

    def tangent_moment(self, parameters: Tree, paths: AnalyticPaths, tangents: Tree) -> np.ndarray:
        del parameters
        along = {key: tangents.get(key, np.zeros_like(value)) for key, value in self._values.items()}
        slopes = (self.matrix @ self._flat(along))[self._rows(paths.pixels)].reshape(-1, 3, 1)
        samples = slopes * (1 + self.noise * (2 * paths.numbers[..., 0] - 1))
        shape = (*self.shape, 3) if paths.pixels is None else (len(paths.pixels), 3)
        squares = (samples**2).reshape(-1, 3, paths.groups, samples.shape[-1] // paths.groups).mean(axis=-1)
        moments = np.moveaxis(squares, -1, 0).reshape(paths.groups, *shape)
        return moments if paths.groups > 1 else moments[0]

    def _flat(self, parameters: Tree) -> np.ndarray:
        return np.concatenate([np.ravel(parameters.get(key, value)) for key, value in self._values.items()])

    def _rows(self, pixels: np.ndarray | None) -> Any:
        if pixels is None:
            return slice(None)
        return (np.asarray(pixels)[:, None] * 3 + np.arange(3)).reshape(-1)

    def _paths(self, request: SampleRequest) -> AnalyticPaths:
        count = self.shape[0] * self.shape[1] if request.pixels is None else len(request.pixels)
        total = count if request.positions is None else int(np.max(request.positions)) + 1
        shape = (total, 3, request.spp, 2)
        return AnalyticPaths(request.seed, shape, request.groups, request.pixels, request.positions)

    def _images(self, parameters: Tree, paths: AnalyticPaths) -> np.ndarray:
        rows = self._rows(paths.pixels)
        linear = (self.matrix @ self._flat(parameters))[rows]
        shape = (*self.shape, 3) if paths.pixels is None else (len(paths.pixels), 3)
        multiplied, added = paths.centred if self.noise or self.grain else np.zeros((2, paths.groups, 1))
        images = self.offset[rows] + linear * (1 + self.noise * multiplied) + self.grain * added
        return images.reshape(paths.groups, *shape)
