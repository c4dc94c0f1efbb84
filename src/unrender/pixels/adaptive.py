"""Pixels drawn where the gradient's variance is: "Image-space Adaptive Sampling for Fast Inverse Rendering" (SIGGRAPH 2025)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels.base import MiniBatch
from unrender.pixels.guided import Clean, GuidedSampler, GuidedSamplerState, MapDenoiser, Maps
from unrender.pixels.pixel_statistics import PixelStatistics
from unrender.pixels.tiles import Tiles
from unrender.problem.problem import Problem


@register
@dataclass(frozen=True)
class Adaptive:
    """p_j ∝ sqrt(E[(∂L/∂I_j)²] · Σ_k E[(∂I_j/∂θ_k)²]), Eq. 12, summed over colours: of all probabilities, those whose gradient has
    the smallest variance, summed over the parameters, when the two factors come from independent paths.

    Both factors are estimated from a few paths in each cell of pixels; the second by one pass in forward mode with random ±1 tangents
    (`Renderer.tangent_moment`). Parameters with a preconditioner count as u, where x = S u, since that is where the descent takes place.
    Estimates, denoised or not, only steer: the gradient is unbiased for whatever probabilities they give.

    With `levels` = D > 0 the probabilities of D + 1 resolutions are averaged (Eq. 18), each compared with references averaged over
    blocks of 2^d × 2^d cells, which draws more pixels to what varies within a block. (The paper's blocks are of pixels; the two
    are the same where there are as many cells as pixels.) The paper has D = 4, against plain things that outweigh textured ones in a sum of
    plain variances; relative ones need it less, and without levels the variance is smaller: `Adaptive(count, levels=4, relative=False)`
    is the paper's.

    Args:
        count: pixels a step, >= 1, drawn with replacement from all pixels of all views.
        levels: D, >= 0.
        refresh: steps between estimates, >= 1.
        samples: paths of an estimate, >= 1, which also says how fine the cells are: one path in each, or several where cells are
            pixels. None for a third of `count`, but 4096 at least (or twice `count`), for each 20 steps that it serves: a few hundredths
            of what the steps cost.
        uniform: share of the draws that every pixel has equally, in (0, 1].
        stratified: spread the draws evenly over the probabilities (`tiles.InverseCdfTable.draw`); otherwise
            they are independent, as in the paper.
        relative: weigh each parameter element's variance by one over its mean squared gradient, which is what Adam divides by: noise counts
            in units of its steps, and the mean over each parameter's elements is what is summed. The sum of plain variances, the
            paper's, looks most at what has the largest gradients.
        denoiser: of the estimated maps: "oidn", "optix", "variation" (see `evaluation.denoising`), "none", or "auto": optix on a GPU, oidn where
            it is installed, else variation.
    """

    count: int
    levels: int = 0
    refresh: int = 20
    samples: int | None = None
    uniform: float = 0.1
    stratified: bool = True
    relative: bool = True
    denoiser: MapDenoiser = "auto"

    def __post_init__(self):
        self._sampler.check()

    @property
    def _sampler(self) -> GuidedSampler:
        return GuidedSampler(
            "Adaptive",
            self.count,
            self.refresh,
            self.samples,
            self.uniform,
            self.stratified,
            self.denoiser,
            levels=self.levels,
            moments=True,
            make=_maps,
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
        """Keep the mean square of the gradient's elements, where variances are `relative`."""
        return self._sampler.observe(problem, state, gradient) if self.relative else state


def _maps(seen: PixelStatistics) -> Maps:
    assert seen.moments is not None
    return (seen.moments, *seen.squares)


def _density(tiles: Tiles, maps: Maps, clean: Clean) -> np.ndarray:
    """The sum over the levels of their probabilities (Eq. 18). Coarser levels average noise away by themselves."""
    moments, *squares = maps
    fine = clean(moments), clean(squares[0])
    total = np.zeros(len(moments))
    for level, square in enumerate(squares):
        product = fine[0] * fine[1] if level == 0 else tiles.coarser(square, level) * tiles.coarser(moments, level)
        density = np.sqrt(np.maximum(product, 0).sum(axis=1))
        share = float((density * tiles.sizes).sum())
        total += density / share if share > 0 else 0.0
    return total
