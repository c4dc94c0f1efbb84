"""Pixel mini-batches from an importance map that is updated from a few paths every `refresh` steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.pixels import pixel_statistics
from unrender.pixels.base import MiniBatch, check_batch
from unrender.pixels.map_denoising import MAP_DENOISERS, MapDenoiser, denoise_map
from unrender.pixels.tiles import InverseCdfTable, Tiles, cut
from unrender.problem.problem import Problem
from unrender.problem.upsampling import SQUARES, Upsampler

__all__ = ["Denoise", "GuidedOptions", "GuidedSampler", "GuidedSamplerState", "ImportanceRule", "Maps"]

_FEWEST_PATHS = 4096
"""The default of `samples` at least: fewer do not resolve where in the images the importance is."""

_OBSERVED, _DECAY = 4, 0.9
"""Steps between updates of the gradient's second moment, and the decay of its running mean."""

_MEMORY = 0.8
"""Weight of the earlier maps in an update, at most; the first updates give them less. The scene changes little between updates, so
averaging reduces noise."""

Maps = tuple[np.ndarray, ...]
"""Statistics of each tile and channel, (tiles, 3) each."""

Denoise = Callable[[np.ndarray], np.ndarray]
"""From a map (tiles, 3) to the denoised map."""


@dataclass(frozen=True)
class GuidedSamplerState:
    """State between steps.

    Attributes:
        age: mini-batches drawn since the last importance-map update.
        maps: the statistics behind the importance map, each with mean 1; empty before the first draw.
        uniform_table: of all tiles, every pixel equally likely.
        table: that mini-batches are drawn from; `uniform_table` before the first update.
        shares: probability of a pixel of each tile relative to uniform sampling, (tiles,).
        references: mean references of the tiles, (tiles, 3).
        refreshes: number of importance-map updates.
        second_moment: running mean square of each element of the gradient, in the coordinates of the descent; empty where it is not
            observed.
    """

    age: int
    maps: Maps
    uniform_table: InverseCdfTable
    table: InverseCdfTable
    shares: np.ndarray
    references: np.ndarray
    refreshes: int = 0
    second_moment: Tree = field(default_factory=dict)

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
    def uniform(self) -> float: ...

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
    def needs_second_moment(self) -> bool:
        """Whether the second moment of the pixels' parameter derivatives is estimated, at the cost of as many paths again."""
        ...

    def maps(self, statistics: pixel_statistics.PixelStatistics) -> Maps:
        """The maps that are averaged over updates."""
        ...

    def density(self, tiles: Tiles, maps: Maps, denoise: Denoise) -> np.ndarray:
        """What the probability of a pixel of each tile is proportional to, (tiles,), >= 0."""
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
        if not checks.number(self.owner, "uniform", options.uniform, above=0.0) <= 1:
            raise InputError(f"{self.owner}: uniform must be a share in (0, 1], got {options.uniform!r}")
        if options.denoiser not in MAP_DENOISERS:
            raise InputError(
                f"{self.owner}: denoiser must be auto, oidn, optix, variation or none, got {options.denoiser!r}"
            )

    def init(self, problem: Problem) -> GuidedSamplerState:
        """See `PixelSampler.init`."""
        check_batch(self.owner, problem, self.options.count)
        tiles = self._tiles(problem)
        uniform_table = InverseCdfTable.of(tiles, tiles.sizes, problem.renderer.array)
        shares = np.ones(len(tiles.views))
        return GuidedSamplerState(
            0, (), uniform_table, uniform_table, shares, pixel_statistics.reference_means(problem, tiles)
        )

    def draw(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[MiniBatch, GuidedSamplerState]:
        """See `PixelSampler.draw`."""
        traced = 0
        if not state.maps or state.age >= self.options.refresh:
            state, traced = self._update_importance_map(problem, parameters, state, key.fold(0))
        batch = replace(self.redraw(problem, state, key), samples=traced)
        return batch, replace(state, age=state.age + 1)

    def redraw(self, problem: Problem, state: GuidedSamplerState, key: Key) -> MiniBatch:
        """See `RepeatableSampler.redraw`."""
        sample = state.table.draw(self.options.count, key.fold(1), self.options.stratified)
        maps = self._tiles(problem).split(state.shares.astype(np.float32))
        return MiniBatch(sample, probability=dict(enumerate(maps)))

    def observe(self, problem: Problem, state: GuidedSamplerState, gradient: Tree) -> GuidedSamplerState:
        """Update the running mean square of the gradient, every few steps, since preconditioning costs time.

        Elements that are not finite count as zeros.
        """
        if state.age % _OBSERVED:
            return state
        pulled = problem.coordinates.pull_back(gradient, {})
        squares = trees.map(lambda g: arrays.where(arrays.is_finite(g), g * g, 0.0), pulled)
        if not state.second_moment or trees.shapes(state.second_moment) != trees.shapes(squares):
            return replace(state, second_moment=squares)
        return replace(
            state,
            second_moment=trees.map(lambda old, new: old * _DECAY + new * (1 - _DECAY), state.second_moment, squares),
        )

    def _tiles(self, problem: Problem) -> Tiles:
        return cut(problem, max(self._paths(), len(problem.views)))

    def _paths(self) -> int:
        """Paths of an importance-map update: `samples`, or a third of a mini-batch's pixels for each twenty steps between updates,
        but 4096 at least, or for small mini-batches twice their pixels."""
        options = self.options
        if options.samples is not None:
            return options.samples
        paths = min(max(options.count // 3, _FEWEST_PATHS), 2 * options.count)
        return max(1, paths * options.refresh // 20)

    def _update_importance_map(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[GuidedSamplerState, int]:
        """The state with an importance map at these parameters, and how many paths were traced for it."""
        tiles = self._tiles(problem)
        spp = max(1, self._paths() // len(tiles.views))
        references = [
            problem.renderer.array(tiles.coarsen(state.references, level)) for level in range(1, self.rule.levels + 1)
        ]
        scales = pixel_statistics.scales(parameters, state.second_moment) if self.rule.needs_second_moment else {}
        statistics = pixel_statistics.estimate_statistics(
            problem, parameters, tiles, state.uniform_table, spp, key, references, scales
        )
        maps = tuple(_normalise(values) for values in self.rule.maps(statistics))
        if state.maps:
            kept = min(_MEMORY, state.refreshes / (state.refreshes + 1))
            maps = tuple(kept * old + (1 - kept) * new for old, new in zip(state.maps, maps, strict=True))
        shares = self._relative_probabilities(tiles, maps)
        table = InverseCdfTable.of(tiles, shares * tiles.sizes, problem.renderer.array)
        updated = replace(state, age=0, maps=maps, table=table, shares=shares, refreshes=state.refreshes + 1)
        return updated, statistics.samples

    def _relative_probabilities(self, tiles: Tiles, maps: Maps) -> np.ndarray:
        """Probability of a pixel of each tile relative to uniform sampling, (tiles,)."""
        density = self.rule.density(tiles, maps, lambda values: denoise_map(tiles, values, self.options.denoiser))
        total = float((density * tiles.sizes).sum())
        if not total > 0:  # no importance was found, or none that is finite
            return np.ones(len(density))
        return (1 - self.options.uniform) * density * (tiles.sizes.sum() / total) + self.options.uniform


def _normalise(values: np.ndarray) -> np.ndarray:
    """A map over its mean, so that updates count alike in the running mean whatever the loss or the units of its variance have become
    in between. Values that are not finite count as zeros."""
    finite = np.where(np.isfinite(values), values, 0.0)
    return finite / (finite.mean() or 1.0)
