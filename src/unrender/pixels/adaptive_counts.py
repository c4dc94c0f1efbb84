"""Whole views with more samples in the pixels where the variance of the gradient is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import checks
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels import pixel_statistics, uniform_share
from unrender.pixels.base import DrawStatistics, MiniBatch
from unrender.pixels.map_denoising import pool
from unrender.pixels.tiles import InverseCdfTable, Maps, Tiles, TileSamples, cut, finite
from unrender.pixels.uniform_share import ShareEvidence
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem
from unrender.scene.sample_counts import SampleShares
from unrender.scene.upsampling import SQUARES, Upsampler

_TILES = 1 << 16
"""Of all views together at most; of single pixels where these are no more."""

_FIRST = 4
"""Steps at the beginning that are all learnt from."""

_COUNTED = 8
"""Times that were learnt from, after which the vertices of paths are counted again."""

_MEMORY = 0.8 ** (1 / 20)
"""Weight, after each further step, of what was learnt before."""

_PRIOR = 64.0
"""Paths that a tile's own mean needs to count as much as its surroundings (`pooling.pool`)."""


@dataclass(frozen=True)
class AdaptiveCountsState:
    """State between steps.

    Attributes:
        step: steps drawn so far.
        maps: second moments of the parameter derivatives and of the loss derivative, (tiles, 3) each; empty before the first are known.
        counts: paths behind each tile, (tiles,); earlier ones count less.
        pooled: the maps, pooled.
        density: what the numbers of samples go by, mean 1 over the pixels, (tiles,).
        uniform: fraction of them that is equal for all pixels.
        evidence: for that fraction.
        since: steps since the maps were last changed.
        costs: what a path through each tile costs, relative to one that meets nothing, (tiles,).
        learnt: how many steps were learnt from.
        second_moment: running mean square of each element of the gradient, in the coordinates of the descent; {} where it is not observed.
    """

    step: int
    maps: Maps
    counts: np.ndarray
    pooled: Maps
    density: np.ndarray
    uniform: float
    evidence: ShareEvidence
    since: int
    costs: np.ndarray
    learnt: int = 0
    second_moment: Tree = field(default_factory=dict)

    def upsampled(self, upsampler: Upsampler) -> AdaptiveCountsState:
        """See `Upsamplable`: the mean squares of the gradient are interpolated, maps of pixels stay."""
        return replace(self, second_moment=upsampler.tree(self.second_moment, SQUARES))


@register
@dataclass(frozen=True)
class AdaptiveCounts:
    """Every pixel of every view at each step, and of the samples more where the variance of the gradient is:

        n_j = m + (s - m) (λ + (1 - λ) q_j),        q_j ∝ sqrt(E[(∂L/∂I_j)²] · Σ_k E[(∂I_j/∂θ_k)²] / c_j),

    for s samples per pixel on average (the estimator's `spp`), m in each, mean 1 of q over a view, and c_j the cost of a path. The variance
    of the gradient is that of all pixels' over their n_j, and q minimises it at equal cost. The numbers are rounded at random before the
    samples are taken, from what earlier steps' samples told; each pixel's samples are weighted by 1 / n_j, and a sample's loss
    derivative is that at the mean of its pixel's other samples. So the gradient is as unbiased as with equal numbers, and every pixel keeps
    its memory of earlier steps: for control variates, too. Where maps are wrong its variance is at most s / m times that of equal
    numbers, or s (s - 1) / (m (m - 1)) times where it is the noise of the images that dominates.

    Both factors are measured by the samples of the steps, the second along random ±1 tangents (`RenderSession.tangent_moment`), in the
    first steps and one of `refresh`; tiles that few paths have met are pooled with those around (`pooling.pool`). λ is 0.8 at first,
    and falls to 0.1 as samples confirm the maps (`uniform_share.choose`), judged as if the noise of the images dominated. Each view
    has its own s samples a pixel.

    Args:
        least: m, samples in each pixel, >= 2; `spp` must be more.
        refresh: steps between those that are learnt from, >= 1.
        uniform: λ, in (0, 1]; None for 0.8 at first, and then by what the samples tell.
        relative: weigh each parameter element's variance by one over its mean squared gradient; see `Adaptive`.
        by_cost: c_j = 1 + v / 2 for v vertices of a path, see `Adaptive`; otherwise c_j = 1.
    """

    least: int = 2
    refresh: int = 10
    uniform: float | None = None
    relative: bool = True
    by_cost: bool = True

    def __post_init__(self):
        checks.integer("AdaptiveCounts", "least", self.least, at_least=2)
        checks.integer("AdaptiveCounts", "refresh", self.refresh, at_least=1)
        share = self.uniform
        if share is not None and not checks.number("AdaptiveCounts", "uniform", share, above=0.0) <= 1:
            raise InputError(f"AdaptiveCounts: uniform must be a share in (0, 1], got {share!r}")

    def init(self, problem: Problem, parameters: Tree) -> AdaptiveCountsState:
        """See `PixelSampler.init`. Raises `InputError` where the loss of a pixel depends on others."""
        del parameters
        if not problem.loss.pixelwise:
            raise InputError(
                f"AdaptiveCounts: {type(problem.loss).__name__} is of whole images, in which each pixel needs as many samples; "
                "use unrender.pixels.All()"
            )
        ones = np.ones(len(_tiles(problem).views))
        uniform = uniform_share.MOST if self.uniform is None else self.uniform
        return AdaptiveCountsState(0, (), ones * 0, (), ones, uniform, ShareEvidence(), 0, ones)

    def draw(
        self, problem: Problem, parameters: Tree, state: AdaptiveCountsState, key: Key
    ) -> tuple[MiniBatch, AdaptiveCountsState]:
        traced, tangents = 0, {}
        if state.step < _FIRST or state.step % self.refresh == 0:
            scales = pixel_statistics.scales(parameters, state.second_moment)
            tangents = pixel_statistics.random_tangents(problem, parameters, scales, key.fold(2))
            if self.by_cost and state.learnt % _COUNTED == 0:
                tiles = _tiles(problem)
                table = InverseCdfTable.of(tiles, tiles.sizes, problem.renderer.array)
                costs, traced = pixel_statistics.costs(problem, parameters, tiles, table, key.fold(3))
                state = replace(state, costs=costs)
        batch = replace(self.redraw(problem, state, key), samples=traced, tangents=tangents)
        return batch, replace(state, step=state.step + 1, since=state.since + 1)

    def redraw(self, problem: Problem, state: AdaptiveCountsState, key: Key) -> MiniBatch:
        tiles = _tiles(problem)
        maps = tiles.split((1 - state.uniform) * state.density + state.uniform)
        films = [problem.renderer.resolutions()[view.sensor] for view in problem.views]
        pixels = [_of_pixels(part, grid.side, film) for part, grid, film in zip(maps, tiles.grids, films, strict=True)]
        offsets = np.random.default_rng(key.fold(1).uint32()).random(len(pixels))
        shares = SampleShares(self.least, tuple(pixels), tuple(offsets.tolist()))
        return MiniBatch(None, probability=dict(enumerate(part.astype(np.float32) for part in maps)), shares=shares)

    def learn(
        self, problem: Problem, state: AdaptiveCountsState, sample: PixelSample | None, draws: DrawStatistics
    ) -> AdaptiveCountsState:
        del sample
        tiles, decay, evidence = _tiles(problem), _MEMORY**state.since, state.evidence
        tile = _tile_of_each_pixel(problem, tiles)
        found = finite(draws.moments), finite(draws.squares)
        counts = np.ones(len(tile)) if draws.counts is None else draws.counts
        samples = TileSamples(tile, found, np.ones(len(tile)), counts)
        values = samples.normalised()
        gain = self._gain(float(counts.mean()))
        if state.pooled:
            told = samples.judged(values, state.pooled)
            evidence = uniform_share.observed(evidence, told, state.density[tile], decay, gain)
        maps, paths = list(state.maps), state.counts * decay
        for index, value in enumerate(values):
            total, number = samples.summed(value, len(tiles.views))
            if state.maps:
                total, number = total + maps[index] * paths[:, None], number + paths
            maps[index : index + 1] = [total / np.maximum(number, 1e-30)[:, None]]
        _, number = samples.summed(values[0], len(tiles.views))
        learnt = replace(
            state, maps=tuple(maps), counts=paths + number, evidence=evidence, since=0, learnt=state.learnt + 1
        )
        return self._mapped(tiles, learnt, gain)

    def _gain(self, spp: float) -> Callable[[np.ndarray], np.ndarray]:
        """One over the variance of a pixel for its number of samples relative to equal ones beyond `least`, where noise of the image is
        all of it: that of n samples goes with 1 / (n (n - 1)), the noise of one times that of the others."""

        def gain(share: np.ndarray) -> np.ndarray:
            number = self.least + (spp - self.least) * share
            return number * (number - 1) / (spp * (spp - 1))

        return gain

    def observe(self, problem: Problem, state: AdaptiveCountsState, gradient: Tree) -> AdaptiveCountsState:
        """Update the mean square of the gradient's elements, where variances are `relative`."""
        if not self.relative:
            return state
        return replace(state, second_moment=pixel_statistics.observed(problem, state.second_moment, gradient))

    def _mapped(
        self, tiles: Tiles, state: AdaptiveCountsState, gain: Callable[[np.ndarray], np.ndarray]
    ) -> AdaptiveCountsState:
        """The state with numbers of samples by its maps and its evidence."""
        pooled = tuple(pool(tiles, values, state.counts, _PRIOR) for values in state.maps)
        density = np.sqrt((pooled[0] * pooled[1]).sum(axis=1) / state.costs)
        parts = zip(tiles.split(density), tiles.split(tiles.sizes), strict=True)
        means = [np.average(part, weights=size) for part, size in parts]
        mean = np.repeat(means, [grid.rows * grid.columns for grid in tiles.grids])
        known = (mean > 0) & np.isfinite(mean)
        density = np.where(known, density, 1.0) / np.where(known, mean, 1.0)
        uniform = self.uniform
        if uniform is None:
            cost = float(np.average(density, weights=tiles.sizes * state.costs))
            uniform = uniform_share.choose(state.evidence, cost, gain)
        return replace(state, pooled=pooled, density=density, uniform=uniform)


def _tiles(problem: Problem) -> Tiles:
    return cut(problem, max(_TILES, len(problem.views)))


def _of_pixels(values: np.ndarray, side: int, film: tuple[int, int]) -> np.ndarray:
    """A map of tiles (rows, columns) as one of pixels."""
    height, width = film
    return values if side == 1 else values.repeat(side, axis=0)[:height].repeat(side, axis=1)[:, :width]


def _tile_of_each_pixel(problem: Problem, tiles: Tiles) -> np.ndarray:
    """Of all views, concatenated."""
    numbers = tiles.split(np.arange(len(tiles.views)))
    films = [problem.renderer.resolutions()[view.sensor] for view in problem.views]
    parts = [_of_pixels(part, grid.side, film) for part, grid, film in zip(numbers, tiles.grids, films, strict=True)]
    return np.concatenate([part.ravel() for part in parts])
