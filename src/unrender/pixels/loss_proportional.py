"""Pixels drawn in proportion to the size of the loss derivative: the scheme before the adaptive one (Su and Gkioulekas 2024)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels.base import MiniBatch
from unrender.pixels.guided import Clean, GuidedSampler, GuidedSamplerState, MapDenoiser, Maps
from unrender.pixels.tiles import Tiles
from unrender.problem.problem import Problem


@register
@dataclass(frozen=True)
class LossProportional:
    """p_j ∝ |∂L/∂I_j| (Eq. 5 of the paper of `Adaptive`): how much a pixel counts, but not how noisy or how telling it is.

    Args:
        count, refresh, samples, uniform, stratified, denoiser: see `Adaptive`.
    """

    count: int
    refresh: int = 20
    samples: int | None = None
    uniform: float = 0.1
    stratified: bool = True
    denoiser: MapDenoiser = "auto"

    def __post_init__(self):
        self._sampler.check()

    @property
    def _sampler(self) -> GuidedSampler:
        return GuidedSampler(
            "LossProportional",
            self.count,
            self.refresh,
            self.samples,
            self.uniform,
            self.stratified,
            self.denoiser,
            levels=0,
            moments=False,
            make=lambda seen: (seen.sizes[0],),
            density=_density,
        )

    def init(self, problem: Problem, parameters: Tree) -> GuidedSamplerState:
        """See `PixelSampler.init`."""
        del parameters
        return self._sampler.init(problem)

    def draw(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[MiniBatch, GuidedSamplerState]:
        """See `PixelSampler.draw`."""
        return self._sampler.draw(problem, parameters, state, key)

    def observe(self, problem: Problem, state: GuidedSamplerState, gradient: Tree) -> GuidedSamplerState:
        """Nothing to learn from."""
        del problem, gradient
        return state


def _density(tiles: Tiles, maps: Maps, clean: Clean) -> np.ndarray:
    del tiles
    return clean(maps[0]).sum(axis=1)
