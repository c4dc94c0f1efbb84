"""Pixel mini-batches from an importance map, of a few paths every `refresh` steps and of the samples of the steps between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from unrender.core import arrays, checks
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.pixels import pixel_statistics, uniform_share
from unrender.pixels.base import DrawStatistics, MiniBatch, check_batch
from unrender.pixels.map_denoising import MAP_DENOISERS, MapDenoiser, denoise_map
from unrender.pixels.tiles import FACTORS, InverseCdfTable, Maps, Tiles, TileSamples, cut, finite
from unrender.pixels.uniform_share import ShareEvidence
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem
from unrender.scene.upsampling import SQUARES, Upsampler

__all__ = ["GuidedOptions", "GuidedSampler", "GuidedSamplerState", "ImportanceRule", "Maps"]

_FEWEST_PATHS, _FIRST_PATHS = 4096, 8
"""The default of `samples` at least: fewer do not resolve where in the images the importance is. Of small mini-batches, for each pixel of
one: updates are then the rarer."""

_OBSERVED = 4
"""Steps between updates of the gradient's second moment."""

_MEMORY = 0.8 ** (1 / 20)
"""Weight, after each further step, of what was learnt before. The scene changes little from step to step, so averaging reduces noise."""

_FIRST = 4
"""Steps at the beginning whose samples change the probabilities of the next step. Later the samples of one step between two updates are
learnt from, and the next update is by them, too: to tell costs a pass over their paths, to change the probabilities a denoising."""

_COUNTED = 8
"""Updates after which the vertices of paths are counted again."""


@dataclass(frozen=True)
class GuidedSamplerState:
    """State between steps.

    Attributes:
        age: mini-batches drawn since the last importance-map update.
        maps: the statistics behind the importance map; empty before the first draw.
        uniform_table: of all tiles, every pixel equally likely.
        table: that mini-batches are drawn from; `uniform_table` before the first update.
        shares: probability of a pixel of each tile relative to uniform sampling, (tiles,).
        references: mean references of the tiles, (tiles, 3).
        refreshes: number of importance-map updates.
        second_moment: running mean square of each element of the gradient, in the coordinates of the descent; empty where it is not
            observed.
        counts: paths behind each tile of each map, (tiles,) each; earlier ones count less.
        denoised: the first maps, denoised, by which samples are judged.
        density: the importance map, relative to uniform sampling, (tiles,).
        uniform: fraction of the draws that is uniform.
        evidence: for that fraction.
        since: steps since the maps were last changed.
        costs: what a path through each tile costs, relative to one that meets nothing, (tiles,); ones where it is not counted.
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
        """See `Upsamplable`: the mean squares of the gradient are interpolated, maps of pixels stay."""
        return replace(self, second_moment=upsampler.tree(self.second_moment, SQUARES))


class GuidedOptions(Protocol):
    """The options that the samplers with an importance map share; `Adaptive` documents them."""

    @property
    def count(self) -> int: ...

    @property
    def refresh(self) -> int: ...

    @property
    def samples(self) -> int | None: ...

    @property
    def uniform(self) -> float | None: ...

    @property
    def stratified(self) -> bool: ...

    @property
    def denoiser(self) -> MapDenoiser: ...


class ImportanceRule(Protocol):
    """What distinguishes one sampler from another: which statistics it needs, and how they become an importance map."""

    @property
    def levels(self) -> int:
        """Coarser resolutions at which the loss derivative is estimated, >= 0."""
        ...

    @property
    def learns(self) -> bool:
        """Whether the samples of the steps are learnt from."""
        ...

    @property
    def by_cost(self) -> bool:
        """Whether pixels count less the more a path through them costs."""
        ...

    @property
    def needs_second_moment(self) -> bool:
        """Whether the second moment of the pixels' parameter derivatives is estimated, at the cost of as many paths again."""
        ...

    def maps(self, statistics: pixel_statistics.PixelStatistics) -> Maps:
        """The maps that are averaged over updates."""
        ...

    def density(self, tiles: Tiles, maps: Maps, denoised: Maps) -> np.ndarray:
        """What the probability of a pixel of each tile is proportional to, (tiles,), >= 0; of the first maps also denoised."""
        ...


@dataclass(frozen=True)
class GuidedSampler:
    """Mini-batches drawn in proportion to an importance map, mixed with uniform sampling.

    Attributes:
        owner: for messages.
        options: of the public sampler.
        rule: that makes the importance map.
    """

    owner: str
    options: GuidedOptions
    rule: ImportanceRule

    def check(self) -> None:
        """Raise `InputError` for options out of range."""
        options = self.options
        for name, value in (("count", options.count), ("refresh", options.refresh)):
            checks.integer(self.owner, name, value, at_least=1)
        checks.integer(self.owner, "levels", self.rule.levels, at_least=0)
        if options.samples is not None:
            checks.integer(self.owner, "samples", options.samples, at_least=1)
        share = options.uniform
        if share is not None and not checks.number(self.owner, "uniform", share, above=0.0) <= 1:
            raise InputError(f"{self.owner}: uniform must be a share in (0, 1], got {share!r}")
        if options.denoiser not in MAP_DENOISERS:
            raise InputError(
                f"{self.owner}: denoiser must be auto, oidn, optix, pooling, variation or none, got {options.denoiser!r}"
            )

    def init(self, problem: Problem) -> GuidedSamplerState:
        check_batch(self.owner, problem, self.options.count)
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
        if not state.maps or state.age >= self.options.refresh:
            state, traced = self._update_importance_map(problem, parameters, state, key.fold(0))
        early = state.refreshes == 1 and state.age < _FIRST
        if self.rule.learns and (early or state.age == self.options.refresh // 2):
            scales = pixel_statistics.scales(parameters, state.second_moment)
            tangents = pixel_statistics.random_tangents(problem, parameters, scales, key.fold(2))
        batch = replace(self.redraw(problem, state, key), samples=traced, tangents=tangents)
        return batch, replace(state, age=state.age + 1, since=state.since + 1)

    def redraw(self, problem: Problem, state: GuidedSamplerState, key: Key) -> MiniBatch:
        sample = state.table.draw(self.options.count, key.fold(1), self.options.stratified)
        maps = self._tiles(problem).split(state.shares.astype(np.float32))
        return MiniBatch(sample, probability=dict(enumerate(maps)))

    def observe(self, problem: Problem, state: GuidedSamplerState, gradient: Tree) -> GuidedSamplerState:
        """Update the running mean square of the gradient, at the first step and every few, since preconditioning costs time.

        Elements that are not finite count as zeros.
        """
        if state.second_moment and state.age % _OBSERVED:
            return state
        return replace(state, second_moment=pixel_statistics.observed(problem, state.second_moment, gradient))

    def _tiles(self, problem: Problem) -> Tiles:
        most = self._paths()
        if self.options.samples is None and self.rule.learns:
            most = max(most, min(_FEWEST_PATHS, _FIRST_PATHS * self.options.count))
        return cut(problem, max(most, len(problem.views)))

    def _paths(self) -> int:
        """Paths of an importance-map update: `samples`, or a third of a mini-batch's pixels for each twenty steps between updates,
        but 4096 at least, or for small mini-batches twice their pixels: on the average over updates, where there are more tiles."""
        options = self.options
        if options.samples is not None:
            return options.samples
        paths = min(max(options.count // 3, _FEWEST_PATHS), 2 * options.count)
        return max(1, paths * options.refresh // 20)

    def _update_importance_map(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[GuidedSamplerState, int]:
        """The state with an importance map at these parameters, and how many paths were traced for it."""
        tiles, paths, counted = self._tiles(problem), self._paths(), 0
        if self.rule.by_cost and state.refreshes % _COUNTED == 0:
            table = state.uniform_table
            costs, counted = pixel_statistics.costs(problem, parameters, tiles, table, key.fold(3))
            state = replace(state, costs=costs)
        if state.maps and state.refreshes % math.ceil(len(tiles.views) / paths):
            # Each tile has a path in an update, of which there are fewer: in between, what was learnt from the steps.
            return self._mapped(problem, tiles, replace(state, age=0, refreshes=state.refreshes + 1)), counted
        spp = max(1, paths // len(tiles.views))
        references = [
            problem.renderer.array(tiles.coarsen(state.references, level)) for level in range(1, self.rule.levels + 1)
        ]
        scales = pixel_statistics.scales(parameters, state.second_moment) if self.rule.needs_second_moment else {}
        statistics = pixel_statistics.estimate_statistics(
            problem, parameters, tiles, state.uniform_table, spp, key, references, scales
        )
        found = tuple(finite(values) for values in self.rule.maps(statistics))
        every = np.arange(len(tiles.views))
        updated = self._added(state, tiles, TileSamples(every, found, tiles.sizes.astype(np.float64), float(spp)))
        updated = self._mapped(problem, tiles, replace(updated, age=0, refreshes=state.refreshes + 1))
        return updated, statistics.samples + counted

    def learn(
        self, problem: Problem, state: GuidedSamplerState, sample: PixelSample, draws: DrawStatistics
    ) -> GuidedSamplerState:
        tiles = self._tiles(problem)
        tile = tiles.locate(arrays.numpy(sample.views).astype(np.int64), arrays.numpy(sample.pixels))
        found = finite(draws.moments), finite(draws.squares)
        learnt = self._added(state, tiles, TileSamples(tile, found, 1 / state.shares[tile]))
        early = state.refreshes == 1 and state.age <= _FIRST
        return self._mapped(problem, tiles, learnt) if early else learnt

    def _added(self, state: GuidedSamplerState, tiles: Tiles, samples: TileSamples) -> GuidedSamplerState:
        """The state with what samples tell of its maps and, where there were some before, of the share of uniform draws."""
        decay, evidence = _MEMORY**state.since, state.evidence
        values = samples.normalised()
        if self.rule.needs_second_moment and state.denoised:
            told = samples.judged(values, state.denoised)
            evidence = uniform_share.observed(evidence, told, state.density[samples.tile], decay)
        maps, counts = list(state.maps), [count * decay for count in state.counts]
        for index, value in enumerate(values):
            total, count = samples.summed(value, len(tiles.views))
            if state.maps:
                total, count = total + maps[index] * counts[index][:, None], count + counts[index]
            mean = total / np.maximum(count, 1e-30)[:, None]
            maps[index : index + 1], counts[index : index + 1] = [mean], [count]
        return replace(state, maps=tuple(maps), counts=tuple(counts), evidence=evidence, since=0)

    def _mapped(self, problem: Problem, tiles: Tiles, state: GuidedSamplerState) -> GuidedSamplerState:
        """The state with probabilities by its maps and its evidence."""
        denoised = tuple(
            np.maximum(denoise_map(tiles, values, self.options.denoiser, counts), 0.0)
            for values, counts in zip(state.maps[:FACTORS], state.counts[:FACTORS], strict=True)
        )
        density = self.rule.density(tiles, state.maps, denoised) / np.sqrt(state.costs)
        total = float((density * tiles.sizes).sum())
        if total > 0 and math.isfinite(total):
            density = density * (float(tiles.sizes.sum()) / total)
        else:  # no importance was found
            density = np.ones(len(density))
        uniform = self.options.uniform
        if uniform is None:
            cost = float(np.average(density, weights=tiles.sizes * state.costs))
            uniform = uniform_share.choose(state.evidence, cost)
        shares = (1 - uniform) * density + uniform
        table = InverseCdfTable.of(tiles, shares * tiles.sizes, problem.renderer.array)
        return replace(state, table=table, shares=shares, denoised=denoised, density=density, uniform=uniform)
