"""Pixel mini-batches from an importance map, which is updated from pilot paths and from the samples of the steps."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.pixels import pixel_statistics, uniform_share
from unrender.pixels.base import DrawStatistics, MiniBatch, check_batch
from unrender.pixels.pixel_statistics import MapDenoiser, denoise_map
from unrender.pixels.tiles import FACTORS, InverseCdfTable, Maps, Tiles, TileSamples, cut, finite
from unrender.pixels.uniform_share import ShareEvidence
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem
from unrender.scene.upsampling import SQUARES, Upsampler

_FEWEST_PATHS, _FIRST_PATHS = 4096, 8
"""Default minimum of `samples`: fewer paths do not resolve the importance over the images.

For small mini-batches it is a multiple of their pixels, and tiles are updated less often.
"""

_OBSERVED = 4  # steps between updates of the gradient's second moment

_MEMORY = 0.8 ** (1 / 20)
"""Decay per step of the weight of earlier samples. The scene changes little from step to step, so averaging reduces noise."""

_FIRST = 4
"""Number of initial steps whose samples change the probabilities of the next step.

Later, the samples of one step between two updates contribute to the next update: statistics cost a pass over their paths, and new
probabilities a denoising.
"""

_COUNTED = 8  # importance-map updates between two counts of path vertices


@dataclass(frozen=True)
class GuidedSamplerState:
    """State between steps.

    Attributes:
        age: number of mini-batches since the last importance-map update.
        maps: statistics of the importance map; empty before the first mini-batch.
        uniform_table: table of all tiles with equal pixel probabilities.
        table: table that mini-batches are sampled from; `uniform_table` before the first update.
        shares: probability of a pixel of each tile relative to uniform sampling, (tiles,).
        references: mean references of the tiles, (tiles, 3).
        refreshes: number of importance-map updates.
        second_moment: running mean square of each element of the gradient with respect to v (`scene.coordinates`); {} if not observed.
        counts: weighted number of paths of each tile and map, (tiles,) each; earlier ones count less.
        denoised: the denoised first maps, against which samples are compared.
        density: importance map relative to uniform sampling, (tiles,).
        since: number of steps since the last map update.
        costs: cost of a path through each tile, relative to one without an intersection, (tiles,); ones if not counted.
    """

    age: int
    maps: Maps
    uniform_table: InverseCdfTable
    table: InverseCdfTable
    shares: np.ndarray
    references: np.ndarray
    refreshes: int = 0
    second_moment: Tree = field(default_factory=dict)
    counts: Maps = ()
    denoised: Maps = ()
    density: np.ndarray = field(default_factory=lambda: np.ones(0))
    uniform: float = 1.0
    evidence: ShareEvidence = field(default_factory=ShareEvidence)
    since: int = 0
    costs: np.ndarray = field(default_factory=lambda: np.ones(0))

    def upsampled(self, upsampler: Upsampler) -> GuidedSamplerState:
        """Return the state with the mean squares of the gradient interpolated; maps of pixels are unchanged."""
        return replace(self, second_moment=upsampler.tree(self.second_moment, SQUARES))


@dataclass(frozen=True)
class ImportanceRule(ABC):
    """Rule that distinguishes the samplers: which statistics they need, and how these become an importance map.

    Attributes:
        levels: number of coarser resolutions at which the loss derivative is estimated, >= 0.
        learns: whether the samples of the steps update the maps.
        by_cost: whether a pixel's importance is divided by the root of its cost.
        needs_second_moment: whether the second moment of the pixels' parameter derivatives is estimated, which doubles the number of paths.
    """

    levels: int = 0
    learns: bool = False
    by_cost: bool = False
    needs_second_moment: bool = False

    @abstractmethod
    def maps(self, statistics: pixel_statistics.PixelStatistics) -> Maps:
        """Return the maps that are averaged over updates."""

    @abstractmethod
    def density(self, tiles: Tiles, maps: Maps, denoised: Maps) -> np.ndarray:
        """Return the unnormalised pixel probability of each tile, (tiles,), >= 0; `denoised` holds the denoised first maps."""


@dataclass(frozen=True)
class GuidedSampler:
    """Sampler of mini-batches by an importance map and uniform sampling, with the options of `Adaptive` but for `owner` and `rule`."""

    owner: str
    rule: ImportanceRule
    count: int
    refresh: int
    samples: int | None
    uniform: float | None
    stratified: bool
    denoiser: MapDenoiser

    def init(self, problem: Problem) -> GuidedSamplerState:
        check_batch(self.owner, problem, self.count)
        tiles = self._tiles(problem)
        uniform_table = InverseCdfTable.of(tiles, tiles.sizes, problem.renderer.array)
        ones = np.ones(len(tiles.views))
        return GuidedSamplerState(
            0,
            (),
            uniform_table,
            uniform_table,
            ones,
            pixel_statistics.reference_means(problem, tiles),
            density=ones,
            costs=ones,
        )

    def draw(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[MiniBatch, GuidedSamplerState]:
        traced, tangents = 0, {}
        if not state.maps or state.age >= self.refresh:
            state, traced = self._update_importance_map(problem, parameters, state, key.fold(0))
        early = state.refreshes == 1 and state.age < _FIRST
        if self.rule.learns and (early or state.age == self.refresh // 2):
            scales = pixel_statistics.scales(parameters, state.second_moment)
            tangents = pixel_statistics.random_tangents(problem, parameters, scales, key.fold(2))
        batch = replace(self.redraw(problem, state, key), samples=traced, tangents=tangents)
        return batch, replace(state, age=state.age + 1, since=state.since + 1)

    def redraw(self, problem: Problem, state: GuidedSamplerState, key: Key) -> MiniBatch:
        sample = state.table.draw(self.count, key.fold(1), self.stratified)
        maps = self._tiles(problem).split(state.shares.astype(np.float32))
        return MiniBatch(sample, probability=dict(enumerate(maps)))

    def observe(self, problem: Problem, state: GuidedSamplerState, gradient: Tree) -> GuidedSamplerState:
        """Update the running mean square of the gradient, at the first step and every few steps, because preconditioning takes time.

        Elements that are not finite count as zeros.
        """
        if state.second_moment and state.age % _OBSERVED:
            return state
        return replace(state, second_moment=pixel_statistics.observed(problem, state.second_moment, gradient))

    def _tiles(self, problem: Problem) -> Tiles:
        most = self._paths()
        if self.samples is None and self.rule.learns:
            most = max(most, min(_FEWEST_PATHS, _FIRST_PATHS * self.count))
        return cut(problem, max(most, len(problem.views)))

    def _paths(self) -> int:
        """Return the mean number of paths per importance-map update.

        It is `samples`, or a third of a mini-batch's pixels for each twenty steps between updates, but at least 4096, or twice the pixels
        of a small mini-batch. If there are more tiles than paths, only some updates trace paths.
        """
        if self.samples is not None:
            return self.samples
        paths = min(max(self.count // 3, _FEWEST_PATHS), 2 * self.count)
        return max(1, paths * self.refresh // 20)

    def _update_importance_map(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[GuidedSamplerState, int]:
        """Return the state with an importance map at these parameters, and the number of paths traced for it."""
        tiles, paths, counted = self._tiles(problem), self._paths(), 0
        if self.rule.by_cost and state.refreshes % _COUNTED == 0:
            table = state.uniform_table
            costs, counted = pixel_statistics.costs(problem, parameters, tiles, table, key.fold(3))
            state = replace(state, costs=costs)
        if state.maps and state.refreshes % math.ceil(len(tiles.views) / paths):
            # One path per tile exceeds the budget, so only some updates trace paths; the others use samples of the steps.
            return self._with_probabilities(
                problem, tiles, replace(state, age=0, refreshes=state.refreshes + 1)
            ), counted
        spp = max(1, paths // len(tiles.views))
        references = [
            problem.renderer.array(tiles.coarsen(state.references, level)) for level in range(1, self.rule.levels + 1)
        ]
        scales = pixel_statistics.scales(parameters, state.second_moment) if self.rule.needs_second_moment else {}
        statistics = pixel_statistics.estimate_statistics(
            problem, parameters, tiles, state.uniform_table, spp, key, references, scales
        )
        factors = tuple(finite(values) for values in self.rule.maps(statistics))
        every = np.arange(len(tiles.views))
        updated = self._with_samples(
            state, tiles, TileSamples(every, factors, tiles.sizes.astype(np.float64), float(spp))
        )
        updated = self._with_probabilities(problem, tiles, replace(updated, age=0, refreshes=state.refreshes + 1))
        return updated, statistics.samples + counted

    def learn(
        self, problem: Problem, state: GuidedSamplerState, sample: PixelSample, draws: DrawStatistics
    ) -> GuidedSamplerState:
        tiles = self._tiles(problem)
        tile = tiles.locate(arrays.numpy(sample.views).astype(np.int64), arrays.numpy(sample.pixels))
        factors = finite(draws.moments), finite(draws.squares)
        updated = self._with_samples(state, tiles, TileSamples(tile, factors, 1 / state.shares[tile]))
        early = state.refreshes == 1 and state.age <= _FIRST
        return self._with_probabilities(problem, tiles, updated) if early else updated

    def _with_samples(self, state: GuidedSamplerState, tiles: Tiles, samples: TileSamples) -> GuidedSamplerState:
        """Return the state with samples added to its maps and, if it had maps before, to the evidence for the uniform fraction."""
        decay, evidence = _MEMORY**state.since, state.evidence
        values = samples.normalised()
        if self.rule.needs_second_moment and state.denoised:
            observed = samples.uniform_evidence(values, state.denoised)
            evidence = uniform_share.observed(evidence, observed, state.density[samples.tile], decay)
        before = [count * decay for count in state.counts]
        maps, counts = samples.averaged(values, len(tiles.views), state.maps, before)
        return replace(state, maps=maps, counts=tuple(counts), evidence=evidence, since=0)

    def _with_probabilities(self, problem: Problem, tiles: Tiles, state: GuidedSamplerState) -> GuidedSamplerState:
        denoised = tuple(
            np.maximum(denoise_map(tiles, values, self.denoiser, counts), 0.0)
            for values, counts in zip(state.maps[:FACTORS], state.counts[:FACTORS], strict=True)
        )
        density = self.rule.density(tiles, state.maps, denoised) / np.sqrt(state.costs)
        total = float((density * tiles.sizes).sum())
        if total > 0 and math.isfinite(total):
            density = density * (float(tiles.sizes.sum()) / total)
        else:  # the importance is zero everywhere
            density = np.ones(len(density))
        uniform = self.uniform
        if uniform is None:
            cost = float(np.average(density, weights=tiles.sizes * state.costs))
            uniform = uniform_share.choose(state.evidence, cost)
        shares = (1 - uniform) * density + uniform
        table = InverseCdfTable.of(tiles, shares * tiles.sizes, problem.renderer.array)
        return replace(state, table=table, shares=shares, denoised=denoised, density=density, uniform=uniform)
