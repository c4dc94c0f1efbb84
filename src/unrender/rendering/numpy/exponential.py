"""The mean of an exponential distribution as a picture of one pixel: the toy problem of Balint et al. 2023, Fig. 2, in NumPy.

A sample is x(u; λ) = −log(1 − u) / λ for a uniform u, so its mean is 1/λ, its variance 1/λ², its derivative −x/λ. All three channels
are equal.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

import numpy as np

from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.rendering.renderer import ParameterInfo, Rendering, SampleRequest, Space

RATE = "rate"
"""The key of its one parameter, λ."""


@dataclass(frozen=True)
class ExponentialPaths:
    """The samples of a rendering at λ = 1, (groups, *shape of a picture, samples of each)."""

    unit: np.ndarray


class ExponentialRenderer:
    """One pixel that shows the mean of an exponential distribution.

    Args:
        rate: its own λ, > 0.
        lowest: the smallest λ that a descent may reach, > 0.
    """

    def __init__(self, rate: float = 0.5, lowest: float = 0.05):
        self.rate, self.lowest = rate, lowest

    def parameters(self) -> Mapping[str, ParameterInfo]:
        return {RATE: ParameterInfo((), lowest=self.lowest)}

    def values(self, keys: list[str]) -> Tree:
        return {key: np.array(self.rate) for key in keys}

    def resolutions(self) -> list[tuple[int, int]]:
        return [(1, 1)]

    def array(self, values: np.ndarray) -> np.ndarray:
        """A NumPy array in double precision."""
        return np.array(values, np.float64)

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> ExponentialRenderer:
        """See `Renderer.prepare`. It holds no state, so it is a session itself."""
        del space, derivatives
        for key in keys:
            if key != RATE:
                raise InputError(f"parameter {key}: the scene has none of that name; it has {RATE}")
        return self

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        shape = (1, 1) if request.pixels is None else (len(request.pixels),)
        numbers = np.random.default_rng(request.seed).random((request.groups, *shape, request.spp // request.groups))
        paths = ExponentialPaths(-np.log1p(-numbers))
        return Rendering(self._images(parameters, paths), None, paths)

    def image_batch(self, parameters: Tree, request: SampleRequest) -> np.ndarray:
        rendering = self.image(parameters={RATE: 1.0}, request=replace(request, groups=1))
        means = rendering.images[0, 0, 0] / np.reshape(parameters[RATE], (-1, 1))
        return means[:, None, None, :]

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """See `RenderSession.image_pair`. Both spaces share the random numbers, which is all there is to share."""
        del space
        rendering = self.image(current, request)
        return Rendering(rendering.images, self._images(previous, rendering.paths), rendering.paths)

    def adjoint(self, parameters: Tree, paths: ExponentialPaths, weights: np.ndarray) -> Tree:
        slopes = -self._images(parameters, paths) / float(parameters[RATE])
        return {RATE: np.array((weights * slopes).sum() / len(slopes))}

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: ExponentialPaths, weights: np.ndarray, weights_previous: np.ndarray
    ) -> tuple[Tree, Tree]:
        return self.adjoint(current, paths, weights), self.adjoint(previous, paths, weights_previous)

    def tangent_moment(self, parameters: Tree, paths: ExponentialPaths, tangents: Tree) -> np.ndarray:
        slopes = paths.unit * float(tangents[RATE]) / float(parameters[RATE]) ** 2
        found = np.repeat(np.mean(slopes**2, axis=-1)[..., None], 3, axis=-1)
        return found if len(found) > 1 else found[0]

    def _images(self, parameters: Tree, paths: ExponentialPaths) -> np.ndarray:
        means = paths.unit.mean(axis=-1) / float(parameters[RATE])
        return np.repeat(means[..., None], 3, axis=-1)
