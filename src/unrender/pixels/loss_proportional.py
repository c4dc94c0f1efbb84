"""Pixel mini-batches in proportion to the magnitude of the loss derivative (Su and Gkioulekas 2024)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unrender.core import checks
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels.base import MiniBatch
from unrender.pixels.guided import GuidedOptions, GuidedSampler, GuidedSamplerState, ImportanceRule, Maps
from unrender.pixels.map_denoising import MapDenoiser
from unrender.pixels.pixel_statistics import PixelStatistics
from unrender.pixels.tiles import Tiles
from unrender.scene.problem import Problem


@register
@dataclass(frozen=True)
class LossProportional:
    """Importance sampling of pixels, p_j = λ u_j + (1 - λ) q_j with uniform u_j and q_j ∝ E|∂L/∂I_j|, summed over the channels. Unbiased.

    This is Eq. 5 of the paper of `Adaptive`. Unlike `Adaptive` it ignores noise and parameter derivatives.

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
        checks.flags(self)
        self._sampler.check()

    @property
    def _sampler(self) -> GuidedSampler:
        own = self.count, self.refresh, self.samples, self.uniform, self.stratified, self.denoiser
        return GuidedSampler("LossProportional", GuidedOptions(*own), _LossDerivative())

    def init(self, problem: Problem, parameters: Tree) -> GuidedSamplerState:
        del parameters
        return self._sampler.init(problem)

    def draw(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[MiniBatch, GuidedSamplerState]:
        return self._sampler.draw(problem, parameters, state, key)

    def redraw(self, problem: Problem, state: GuidedSamplerState, key: Key) -> MiniBatch:
        return self._sampler.redraw(problem, state, key)

    def observe(self, problem: Problem, state: GuidedSamplerState, gradient: Tree) -> GuidedSamplerState:
        """Return the state unchanged."""
        del problem, gradient
        return state


@dataclass(frozen=True)
class _LossDerivative(ImportanceRule):
    """Importance of Eq. 5."""

    def maps(self, statistics: PixelStatistics) -> Maps:
        """Return the mean magnitude of the loss derivative."""
        return (statistics.magnitudes[0],)

    def density(self, tiles: Tiles, maps: Maps, denoised: Maps) -> np.ndarray:
        """Return the sum over the channels."""
        del tiles, maps
        return denoised[0].sum(axis=1)
