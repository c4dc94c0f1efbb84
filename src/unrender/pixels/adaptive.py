"""Pixel mini-batches that reduce the variance of the gradient: "Image-space Adaptive Sampling for Fast Inverse Rendering" (SIGGRAPH
2025)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from unrender.core import checks
from unrender.core.checks import Count, Index
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels import uniform_share
from unrender.pixels.base import DrawStatistics, MiniBatch, PixelSampler
from unrender.pixels.guided import GuidedSampler, GuidedSamplerState, ImportanceRule, Maps
from unrender.pixels.pixel_statistics import MapDenoiser, PixelStatistics
from unrender.pixels.tiles import Tiles
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem

_FEWEST = 4096
"""Number of pixels of a mini-batch whose paths take as long as the rest of a step (2 cores, 2 samples per pixel, problem `caustic`)."""


def default_count(problem: Problem) -> int:
    """Return the default number of pixels of a mini-batch."""
    return min(problem.pixels, max(problem.pixels // 4, _FEWEST))


class _Guided(ABC):
    """A sampler whose options define a `GuidedSampler`."""

    @abstractmethod
    def _sampler_for(self, problem: Problem) -> GuidedSampler: ...

    def init(self, problem: Problem, parameters: Tree) -> GuidedSamplerState:
        return self._sampler_for(problem).init(problem)

    def draw(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[MiniBatch, GuidedSamplerState]:
        return self._sampler_for(problem).draw(problem, parameters, state, key)

    def redraw(self, problem: Problem, state: GuidedSamplerState, key: Key) -> MiniBatch:
        return self._sampler_for(problem).redraw(problem, state, key)


@register
@dataclass(frozen=True)
class Adaptive(_Guided):
    """Importance sampling of pixels, p_j = λ u_j + (1 - λ) q_j with uniform u_j and q_j ∝ sqrt(E[(∂L/∂I_j)²] · Σ_k E[(∂I_j/∂θ_k)²] / c_j)
    (Eq. 12).

    The sums include the colour channels. If the two factors come from independent paths, q minimises the gradient's variance, summed over
    the parameters, per cost c_j of a path. Both factors are estimated from a few paths per tile of pixels and denoised. The second factor
    uses one forward-mode pass with random ±1 tangents (`RenderSession.tangent_moment`); for moving shapes it includes the derivative of
    visibility discontinuities. Samples of the first steps, and of one step between two updates, contribute to both factors
    (`LearningSampler`) if the estimator reports them. θ is the optimizer's variable v (`scene.coordinates`). The gradient is unbiased for
    any positive probabilities, so errors of these estimates affect only its variance.

    A few paths may miss rare bright ones, and such a map can make the variance many times that of uniform sampling. Because p_j >= λ u_j,
    the second moment of the gradient is at most 1 / λ times that of uniform sampling. λ starts at 0.8, a factor of at most 1.25, and
    decreases as samples confirm the map: each sample, weighted by its probability, gives an estimate of the second moment under any other
    probabilities (`uniform_share.choose`).

    With `levels` = D > 0 the probabilities of D + 1 resolutions are averaged (Eq. 18). Each coarser level compares renderings with
    references averaged over blocks of 2^d × 2^d tiles, which favours pixels where the reference varies within a block. (The paper's
    blocks consist of pixels; both are equal if there are as many tiles as pixels.) The paper uses D = 4, because in a sum of plain
    variances uniform regions can outweigh textured ones. Relative variances need it less, and the variance is smaller without levels. The
    paper's variant is `Adaptive(count, levels=4, relative=False, uniform=0.1, learn_from_draws=False, by_cost=False)`.

    Args:
        count: pixels per step, >= 1, sampled with replacement from all pixels of all views. None takes a quarter of all pixels, but at
            least 4096 or all: on a processor, fewer pixels are hardly faster because of a step's fixed cost.
        levels: D, >= 0.
        refresh: steps between importance-map updates, >= 1.
        samples: paths per update, >= 1; None for min(max(`count` / 3, 4096), 2 `count`) · `refresh` / 20, a few percent of the cost of
            the steps. There are as many tiles as paths, but at most one per pixel. With None there are at least min(8 `count`, 4096)
            tiles; if these are more than the paths, only some updates trace one path per tile.
        uniform: λ, fraction of uniform samples, in (0, 1]. None starts at 0.8 and then chooses between 0.1 and 0.8 from the samples.
        stratified: whether samples are stratified over the distribution (`tiles.InverseCdfTable.draw`); independent otherwise, as in the
            paper.
        relative: whether each parameter element's variance is divided by its mean squared gradient, as Adam does. Noise then counts in
            units of Adam's steps, and the means over each parameter's elements are summed. In the paper's sum of plain variances the
            parameters with the largest gradients dominate.
        denoiser: denoiser of the maps: "oidn", "optix", "variation" (see `images.denoising`), "pooling" with neighbouring tiles
            (`pixel_statistics.pool`), "none", or "auto": optix on a GPU, oidn if installed, else pooling.
        learn_from_draws: whether samples of the steps update the maps; otherwise only the updates do, as in the paper.
        by_cost: whether c_j = 1 + v / 2 with the mean number v of vertices of a path through the pixel, which minimises variance times
            cost, because paths that leave the scene are cheap. λ accounts for the cost, too. Otherwise c_j = 1.
    """

    count: Count | None = None
    levels: Index = 0
    refresh: Count = 20
    samples: Count | None = None
    uniform: float | None = None
    stratified: bool = True
    relative: bool = True
    denoiser: MapDenoiser = "auto"
    learn_from_draws: bool = True
    by_cost: bool = True

    def __post_init__(self):
        checks.fields(self)
        uniform_share.check("Adaptive", self.uniform)

    def _sampler_for(self, problem: Problem) -> GuidedSampler:
        count = default_count(problem) if self.count is None else self.count
        rule = _GradientVariance(self.levels, self.learn_from_draws, self.by_cost, needs_second_moment=True)
        own = self.refresh, self.samples, self.uniform, self.stratified, self.denoiser
        return GuidedSampler("Adaptive", rule, count, *own)

    def learn(
        self, problem: Problem, state: GuidedSamplerState, sample: PixelSample, draws: DrawStatistics
    ) -> GuidedSamplerState:
        return self._sampler_for(problem).learn(problem, state, sample, draws)

    def observe(self, problem: Problem, state: GuidedSamplerState, gradient: Tree) -> GuidedSamplerState:
        """Update the running mean square of the gradient's elements if variances are `relative`."""
        return self._sampler_for(problem).observe(problem, state, gradient) if self.relative else state


@dataclass(frozen=True)
class _GradientVariance(ImportanceRule):
    """Importance of Eq. 12, averaged over levels by Eq. 18."""

    def maps(self, statistics: PixelStatistics) -> Maps:
        return (statistics.second_moment, *statistics.squares)

    def density(self, tiles: Tiles, maps: Maps, denoised: Maps) -> np.ndarray:
        """Return the sum of the levels' probabilities (Eq. 18). Coarser levels are means over blocks and need no denoising."""
        second_moment, *squares = maps
        total = np.zeros(len(second_moment))
        for level, square in enumerate(squares):
            if level == 0:
                product = denoised[0] * denoised[1]
            else:
                product = tiles.coarsen(square, level) * tiles.coarsen(second_moment, level)
            density = np.sqrt(np.maximum(product, 0).sum(axis=1))
            mass = float((density * tiles.sizes).sum())
            total += density / mass if mass > 0 else 0.0
        return total


@register
@dataclass(frozen=True)
class LossProportional(_Guided, PixelSampler):
    """Importance sampling of pixels, p_j = λ u_j + (1 - λ) q_j with uniform u_j and q_j ∝ E|∂L/∂I_j|, summed over the channels. Unbiased.

    This is Eq. 5 of the paper of `Adaptive`. Unlike `Adaptive` it ignores noise and parameter derivatives.

    Args:
        count, refresh, samples, uniform, stratified, denoiser: see `Adaptive`.
    """

    count: Count
    refresh: Count = 20
    samples: Count | None = None
    uniform: float = 0.1
    stratified: bool = True
    denoiser: MapDenoiser = "auto"

    def __post_init__(self):
        checks.fields(self)
        uniform_share.check("LossProportional", self.uniform)

    def _sampler_for(self, problem: Problem) -> GuidedSampler:
        own = self.count, self.refresh, self.samples, self.uniform, self.stratified, self.denoiser
        return GuidedSampler("LossProportional", _LossDerivative(), *own)


@dataclass(frozen=True)
class _LossDerivative(ImportanceRule):
    """Importance of Eq. 5."""

    def maps(self, statistics: PixelStatistics) -> Maps:
        return (statistics.magnitudes[0],)

    def density(self, tiles: Tiles, maps: Maps, denoised: Maps) -> np.ndarray:
        return denoised[0].sum(axis=1)
