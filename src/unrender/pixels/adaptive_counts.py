"""Full views with more samples in pixels of high gradient variance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import checks
from unrender.core.checks import Count, Several
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.pixels import pixel_statistics, uniform_share
from unrender.pixels.base import DrawStatistics, MiniBatch
from unrender.pixels.pixel_statistics import pool
from unrender.pixels.tiles import InverseCdfTable, Maps, Tiles, TileSamples, cut, finite
from unrender.pixels.uniform_share import ShareEvidence
from unrender.scene.batches import PixelSample, SampleShares
from unrender.scene.problem import Problem
from unrender.scene.upsampling import SQUARES, Upsampler

_TILES = 1 << 16  # maximum number of tiles of all views; tiles are single pixels if there are no more pixels
_FIRST = 4  # number of initial steps that all update the maps
_COUNTED = 8  # number of map updates between two counts of path vertices
_MEMORY = 0.8 ** (1 / 20)  # decay per step of the weight of earlier samples


@dataclass(frozen=True)
class AdaptiveCountsState:
    """State between steps.

    Attributes:
        step: number of steps so far.
        maps: second moments of the parameter derivatives and of the loss derivative, (tiles, 3) each; empty before the first update.
        counts: weighted number of paths of each tile, (tiles,); earlier ones count less.
        density: relative density of additional samples, with mean 1 over the pixels, (tiles,).
        uniform: fraction of these that is equal for all pixels.
        since: number of steps since the last map update.
        costs: cost of a path through each tile, relative to one without an intersection, (tiles,).
        learnt: number of map updates from steps.
        second_moment: running mean square of each element of the gradient with respect to v (`scene.coordinates`); {} if not observed.
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
        """Return the state with the mean squares of the gradient interpolated; maps of pixels are unchanged."""
        return replace(self, second_moment=upsampler.tree(self.second_moment, SQUARES))


@register
@dataclass(frozen=True)
class AdaptiveCounts:
    """All pixels of all views at each step, with more samples in pixels of high gradient variance:

        n_j = m + (s - m) (λ + (1 - λ) q_j),        q_j ∝ sqrt(E[(∂L/∂I_j)²] · Σ_k E[(∂I_j/∂θ_k)²] / c_j),

    for s samples per pixel on average (the estimator's `spp`), at least m per pixel, mean 1 of q over a view, and cost c_j of a path. The
    gradient's variance is the sum of the pixels' variances divided by n_j, which q minimises at equal cost. Random rounding of n_j
    precedes the sampling and uses earlier steps' samples only. Each sample is weighted by 1 / n_j, and its loss derivative is evaluated
    at the mean of its pixel's other samples. So the gradient is as unbiased as with equal numbers, and every pixel keeps its state, as
    control variates need. If maps are wrong, the variance is at most s / m times that of equal numbers, or s (s - 1) / (m (m - 1)) times
    if the images' noise dominates.

    The samples of the first steps, and of every `refresh`-th step, estimate both factors, the second along random ±1 tangents
    (`RenderSession.tangent_moment`). Tiles with few paths are pooled with neighbouring ones (`pixel_statistics.pool`). λ starts at 0.8 and
    decreases to 0.1 as samples confirm the maps (`uniform_share.choose`), under the assumption that the images' noise dominates. Each
    view has its own s samples per pixel.

    Args:
        least: m, samples in each pixel, >= 2; `spp` must be larger.
        refresh: interval of map updates in steps, >= 1.
        uniform: λ, in (0, 1]; None starts at 0.8 and then chooses from the samples.
        relative: whether each parameter element's variance is divided by its mean squared gradient; see `Adaptive`.
        by_cost: whether c_j = 1 + v / 2 for v vertices of a path, see `Adaptive`; otherwise c_j = 1.
    """

    least: Several = 2
    refresh: Count = 10
    uniform: float | None = None
    relative: bool = True
    by_cost: bool = True

    def __post_init__(self):
        checks.fields(self)
        uniform_share.check("AdaptiveCounts", self.uniform)

    def init(self, problem: Problem, parameters: Tree) -> AdaptiveCountsState:
        """Return the state before the first step. Raises `InputError` for a loss that is not pixelwise."""
        if not problem.loss.pixelwise:
            raise InputError(
                f"AdaptiveCounts: {type(problem.loss).__name__} is a loss of full images, in which each pixel needs as many samples; "
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
        pixels = [_per_pixel(part, grid.side, film) for part, grid, film in zip(maps, tiles.grids, films, strict=True)]
        offsets = np.random.default_rng(key.fold(1).uint32()).random(len(pixels))
        shares = SampleShares(self.least, tuple(pixels), tuple(offsets.tolist()))
        return MiniBatch(None, probability=dict(enumerate(part.astype(np.float32) for part in maps)), shares=shares)

    def learn(
        self, problem: Problem, state: AdaptiveCountsState, sample: PixelSample | None, draws: DrawStatistics
    ) -> AdaptiveCountsState:
        tiles, decay, evidence = _tiles(problem), _MEMORY**state.since, state.evidence
        tile = _tile_of_each_pixel(problem, tiles)
        factors = finite(draws.moments), finite(draws.squares)
        paths = np.ones(len(tile)) if draws.counts is None else draws.counts
        samples = TileSamples(tile, factors, np.ones(len(tile)), paths)
        values = samples.normalised()
        gain = self._gain(float(paths.mean()))
        if state.pooled:
            observed = samples.uniform_evidence(values, state.pooled)
            evidence = uniform_share.observed(evidence, observed, state.density[tile], decay, gain)
        before = [state.counts * decay] * len(values)
        maps, (counts, *_) = samples.averaged(values, len(tiles.views), state.maps, before)
        updated = replace(state, maps=maps, counts=counts, evidence=evidence, since=0, learnt=state.learnt + 1)
        return self._with_density(tiles, updated, gain)

    def _gain(self, spp: float) -> Callable[[np.ndarray], np.ndarray]:
        """Return the inverse of a pixel's variance as a function of its relative number of additional samples, if image noise dominates.

        The variance for n samples is then proportional to 1 / (n (n - 1)): the noise of one sample times that of the others.
        """

        def gain(share: np.ndarray) -> np.ndarray:
            number = self.least + (spp - self.least) * share
            return number * (number - 1) / (spp * (spp - 1))

        return gain

    def observe(self, problem: Problem, state: AdaptiveCountsState, gradient: Tree) -> AdaptiveCountsState:
        """Update the running mean square of the gradient's elements if variances are `relative`."""
        if not self.relative:
            return state
        return replace(state, second_moment=pixel_statistics.observed(problem, state.second_moment, gradient))

    def _with_density(
        self, tiles: Tiles, state: AdaptiveCountsState, gain: Callable[[np.ndarray], np.ndarray]
    ) -> AdaptiveCountsState:
        """Return the state with a density of samples from its maps and its evidence."""
        pooled = tuple(pool(tiles, values, state.counts) for values in state.maps)
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


def _per_pixel(values: np.ndarray, side: int, film: tuple[int, int]) -> np.ndarray:
    """Expand a map of tiles (rows, columns) to pixels."""
    height, width = film
    return values if side == 1 else values.repeat(side, axis=0)[:height].repeat(side, axis=1)[:, :width]


def _tile_of_each_pixel(problem: Problem, tiles: Tiles) -> np.ndarray:
    """Return the tile index of each pixel of all views, concatenated."""
    numbers = tiles.split(np.arange(len(tiles.views)))
    films = [problem.renderer.resolutions()[view.sensor] for view in problem.views]
    parts = [_per_pixel(part, grid.side, film) for part, grid, film in zip(numbers, tiles.grids, films, strict=True)]
    return np.concatenate([part.ravel() for part in parts])
