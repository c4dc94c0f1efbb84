"""Pixel mini-batches drawn where the variance of the gradient is: "Image-space Adaptive Sampling for Fast Inverse Rendering"
(SIGGRAPH 2025)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels.base import DrawStatistics, MiniBatch
from unrender.pixels.guided import GuidedSampler, GuidedSamplerState, Maps
from unrender.pixels.map_denoising import MapDenoiser
from unrender.pixels.pixel_statistics import PixelStatistics
from unrender.pixels.tiles import Tiles
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem

_FEWEST = 4096
"""Pixels of a mini-batch whose paths take as long as the rest of a step: on 2 cores, with 2 samples a pixel of `caustic`."""


def default_count(problem: Problem) -> int:
    """How many pixels a mini-batch has where that is not given."""
    return min(problem.pixels, max(problem.pixels // 4, _FEWEST))


@dataclass(frozen=True)
class _Options:
    """See `GuidedOptions`."""

    count: int
    refresh: int
    samples: int | None
    uniform: float | None
    stratified: bool
    denoiser: MapDenoiser


@register
@dataclass(frozen=True)
class Adaptive:
    """p_j = λ u_j + (1 - λ) q_j with q_j ∝ sqrt(E[(∂L/∂I_j)²] · Σ_k E[(∂I_j/∂θ_k)²] / c_j), Eq. 12, summed over colours: of all
    probabilities, those whose gradient has the least variance, summed over the parameters, when the two factors come from independent
    paths; per cost c_j of a path, and mixed with uniform sampling u.

    Both factors are estimated from a few paths per tile of pixels, denoised; the second by one pass in forward mode with random ±1
    tangents (`RenderSession.tangent_moment`), where shapes move with the derivative by the borders of silhouettes and shadows. The
    samples of the first steps, and of one between two updates, add to both (`LearningSampler`), where the estimator can tell what they
    saw. Parameters with a preconditioner count as u, where x = S u, the coordinates of the descent. The gradient is unbiased for any
    positive probabilities, so errors of these estimates change its variance only.

    Few paths know nothing of rare bright ones, and a map that has missed them can make the variance many times that of uniform
    sampling. Since p_j >= λ u_j, the second moment of the gradient is at most 1 / λ times uniform sampling's. λ is 0.8 at first, so at
    most 1.25 times; it falls as samples confirm the map: each tells, with its probability, the second moment under any other
    probabilities (`uniform_share.choose`).

    With `levels` = D > 0 the probabilities of D + 1 resolutions are averaged (Eq. 18). Each coarser one compares renders with references
    averaged over blocks of 2^d × 2^d tiles, which draws more pixels where the reference varies within a block. (The paper's blocks are
    of pixels; the two are the same where there are as many tiles as pixels.) The paper has D = 4, because in a sum of plain variances
    uniform regions can outweigh textured ones; relative variances need it less, and without levels the variance is smaller:
    the paper's is
    `Adaptive(count, levels=4, relative=False, uniform=0.1, learn_from_draws=False, by_cost=False)`.

    Args:
        count: pixels a step, >= 1, drawn with replacement from all pixels of all views. None for a quarter of these, but for 4096 at least
            where there are as many: on a processor the fixed cost of a step is that of so many pixels, so fewer are hardly faster.
        levels: D, >= 0.
        refresh: steps between importance-map updates, >= 1.
        samples: paths of an update, >= 1, which also sets how fine the tiles are: one path in each, or several where tiles are
            pixels. None for a third of `count`, but 4096 at least (or twice `count`, of the first eight times), for each 20 steps
            between updates: a few hundredths of the cost of the steps.
        uniform: λ, fraction of the draws that is uniform over all pixels, in (0, 1]. None for 0.8 at first, and then between 0.1 and 0.8
            by what the samples tell.
        stratified: stratify the draws over the distribution (`tiles.InverseCdfTable.draw`); otherwise they are independent, as in the
            paper.
        relative: weigh each parameter element's variance by one over its mean squared gradient, which is what Adam divides by: noise counts
            in units of Adam's steps, and the mean over each parameter's elements is summed. The sum of plain variances, the paper's,
            is dominated by the parameters with the largest gradients.
        denoiser: of the estimated maps: "oidn", "optix", "variation" (see `evaluation.denoising`), "pooling" with the tiles around
            (`pooling.pool`), "none", or "auto": optix on a GPU, oidn where it is installed, else pooling.
        learn_from_draws: learn from the samples of the steps, too; otherwise from the updates alone, as in the paper.
        by_cost: c_j = 1 + v / 2 for the mean number v of vertices of a path through the pixel, counted: the probabilities with the least
            variance times cost of a step, since a path into the sky costs little. λ follows the cost, too. Otherwise c_j = 1.
    """

    count: int | None = None
    levels: int = 0
    refresh: int = 20
    samples: int | None = None
    uniform: float | None = None
    stratified: bool = True
    relative: bool = True
    denoiser: MapDenoiser = "auto"
    learn_from_draws: bool = True
    by_cost: bool = True

    def __post_init__(self):
        self._sampler(_FEWEST if self.count is None else self.count).check()

    def _sampler(self, count: int) -> GuidedSampler:
        options = _Options(count, self.refresh, self.samples, self.uniform, self.stratified, self.denoiser)
        return GuidedSampler("Adaptive", options, _GradientVariance(self.levels, self.learn_from_draws, self.by_cost))

    def _of(self, problem: Problem) -> GuidedSampler:
        return self._sampler(default_count(problem) if self.count is None else self.count)

    def init(self, problem: Problem, parameters: Tree) -> GuidedSamplerState:
        del parameters
        return self._of(problem).init(problem)

    def draw(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[MiniBatch, GuidedSamplerState]:
        return self._of(problem).draw(problem, parameters, state, key)

    def redraw(self, problem: Problem, state: GuidedSamplerState, key: Key) -> MiniBatch:
        return self._of(problem).redraw(problem, state, key)

    def learn(
        self, problem: Problem, state: GuidedSamplerState, sample: PixelSample, draws: DrawStatistics
    ) -> GuidedSamplerState:
        return self._of(problem).learn(problem, state, sample, draws)

    def observe(self, problem: Problem, state: GuidedSamplerState, gradient: Tree) -> GuidedSamplerState:
        """Update the mean square of the gradient's elements, where variances are `relative`."""
        return self._of(problem).observe(problem, state, gradient) if self.relative else state


@dataclass(frozen=True)
class _GradientVariance:
    """The importance of Eq. 12, averaged over levels by Eq. 18."""

    levels: int
    learns: bool
    by_cost: bool
    needs_second_moment: bool = True

    def maps(self, statistics: PixelStatistics) -> Maps:
        """Second moment of the parameter derivatives, then per level that of the loss derivative."""
        return (statistics.second_moment, *statistics.squares)

    def density(self, tiles: Tiles, maps: Maps, denoised: Maps) -> np.ndarray:
        """The sum over the levels of their probabilities (Eq. 18). Coarser levels are means over blocks and need no denoising."""
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
