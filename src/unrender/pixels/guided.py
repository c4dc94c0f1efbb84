"""Probabilities that follow the descent: estimated anew from few paths every so many steps, cleaned, mixed with equal ones."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.evaluation import denoising
from unrender.pixels import pixel_statistics
from unrender.pixels.base import MiniBatch, check_loss
from unrender.pixels.tiles import InverseCdfTable, Tiles, cut
from unrender.problem.problem import Problem
from unrender.problem.upsampling import SQUARES, Upsampler

MapDenoiser = Literal["auto", "oidn", "optix", "variation", "none"]
_MARGIN = 4
"""Cells between maps that are denoised together."""

_FEWEST_PATHS = 4096
"""Fewer do not tell where in the pictures things are."""

_OBSERVED, _DECAY = 4, 0.9
"""Every how many steps the gradient's squares are looked at, and how much of what was seen stays."""

_MEMORY = 0.8
"""What a refresh keeps of the maps before it at most, the first ones less: the scene changes little in between, and noise averages out."""

Maps = tuple[np.ndarray, ...]
"""Of each cell and channel, (cells, 3) each."""


Clean = Callable[[np.ndarray], np.ndarray]
"""A map without its noise."""


@dataclass(frozen=True)
class GuidedSamplerState:
    """State between steps.

    Attributes:
        age: draws since the maps were made.
        maps: what the probabilities are made of, each with mean 1; empty before the first draw.
        spots: a table of all cells, equally likely per pixel.
        table: of the draws; `uniform_table` before the first.
        shares: how likely a pixel of each cell is, relative to equal probabilities, (cells,).
        references: mean references of the cells, (cells, 3).
        refreshes: how many there were.
        energy: mean square of each element of the gradient, in the coordinates of the descent; empty where it was not observed.
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


@dataclass(frozen=True)
class GuidedSampler:
    """How a scheme keeps its probabilities.

    Attributes:
        owner: for messages.
        count, refresh, samples, uniform, stratified, denoiser: see `Adaptive`.
        levels: coarser levels that the loss is looked at on.
        moments: whether the derivatives of pixels are looked at.
        make: from what was seen to maps.
        density: from cells, maps and what cleans a map, to what a pixel's probability is proportional to, (cells,), >= 0.
    """

    owner: str
    count: int
    refresh: int
    samples: int | None
    uniform: float
    stratified: bool
    denoiser: MapDenoiser
    levels: int
    moments: bool
    make: Callable[[pixel_statistics.PixelStatistics], Maps]
    density: Callable[[Tiles, Maps, Clean], np.ndarray]

    def check(self) -> None:
        """Raise `InputError` for options that make no sense."""
        for name, value in (("count", self.count), ("refresh", self.refresh)):
            checks.integer(self.owner, name, value, at_least=1)
        checks.integer(self.owner, "levels", self.levels, at_least=0)
        if self.samples is not None:
            checks.integer(self.owner, "samples", self.samples, at_least=1)
        if not checks.number(self.owner, "uniform", self.uniform, above=0.0) <= 1:
            raise InputError(f"{self.owner}: uniform must be a share in (0, 1], got {self.uniform!r}")
        if self.denoiser not in ("auto", "oidn", "optix", "variation", "none"):
            raise InputError(
                f"{self.owner}: denoiser must be auto, oidn, optix, variation or none, got {self.denoiser!r}"
            )

    def init(self, problem: Problem) -> GuidedSamplerState:
        """See `PixelSampler.init`."""
        check_loss(problem)
        tiles = self._cells(problem)
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
        if not state.maps or state.age >= self.refresh:
            state, traced = self._renew(problem, parameters, state, key.fold(0))
        draw = state.table.draw(self.count, key.fold(1), self.stratified)
        maps = self._cells(problem).split(state.shares.astype(np.float32))
        return MiniBatch(draw, traced, dict(enumerate(maps))), replace(state, age=state.age + 1)

    def observe(self, problem: Problem, state: GuidedSamplerState, gradient: Tree) -> GuidedSamplerState:
        """Take a gradient's squares in, every few steps, since preconditioning costs something; those that are not finite as zeros."""
        if state.age % _OBSERVED:
            return state
        squares = trees.map(lambda g: arrays.where(arrays.is_finite(g), g * g, 0.0), problem.precondition(gradient))
        if not state.second_moment or trees.shapes(state.second_moment) != trees.shapes(squares):
            return replace(state, second_moment=squares)
        return replace(
            state,
            second_moment=trees.map(lambda old, new: old * _DECAY + new * (1 - _DECAY), state.second_moment, squares),
        )

    def _cells(self, problem: Problem) -> Tiles:
        return cut(problem, max(self._budget(), len(problem.views)))

    def _budget(self) -> int:
        """Paths of a refresh: by default a third of a step's pixels, for each twenty steps that it serves; at least 4096, or for
        small steps twice their pixels."""
        if self.samples is not None:
            return self.samples
        return max(1, min(max(self.count // 3, _FEWEST_PATHS), 2 * self.count) * self.refresh // 20)

    def _renew(
        self, problem: Problem, parameters: Tree, state: GuidedSamplerState, key: Key
    ) -> tuple[GuidedSamplerState, int]:
        tiles = self._cells(problem)
        spp = max(1, self._budget() // len(tiles.views))
        references = [
            problem.renderer.array(tiles.coarser(state.references, level)) for level in range(1, self.levels + 1)
        ]
        scales = pixel_statistics.scales(parameters, state.second_moment) if self.moments else {}
        seen = pixel_statistics.estimate_statistics(
            problem, parameters, tiles, state.uniform_table, spp, key, references, scales
        )
        maps = tuple(_shape(values) for values in self.make(seen))
        if state.maps:
            kept = min(_MEMORY, state.refreshes / (state.refreshes + 1))
            maps = tuple(kept * old + (1 - kept) * new for old, new in zip(state.maps, maps, strict=True))
        shares = self._shares(tiles, maps)
        table = InverseCdfTable.of(tiles, shares * tiles.sizes, problem.renderer.array)
        found = replace(state, age=0, maps=maps, table=table, shares=shares, refreshes=state.refreshes + 1)
        return found, seen.samples

    def _shares(self, tiles: Tiles, maps: Maps) -> np.ndarray:
        """How likely a pixel of each cell is, relative to equal probabilities."""
        density = self.density(tiles, maps, lambda values: self._clean(tiles, values))
        total = float((density * tiles.sizes).sum())
        if not total > 0:  # nothing seen is as good as not knowing
            return np.ones(len(density))
        return (1 - self.uniform) * density * (tiles.sizes.sum() / total) + self.uniform

    def _clean(self, tiles: Tiles, values: np.ndarray) -> np.ndarray:
        by = self.denoiser
        if by == "none":
            return values
        if by == "auto" and denoising.variant.current() != denoising.variant.CUDA:
            by = "oidn" if importlib.util.find_spec("pyoidn") else "variation"
        maps = tiles.split(values)
        found: list[np.ndarray] = [np.empty(0)] * len(maps)
        for shape in {part.shape for part in maps}:
            alike = [index for index, part in enumerate(maps) if part.shape == shape]
            cleaned = _together(
                np.stack([maps[index] for index in alike]), lambda x: denoising.denoise(x, by=by, fast=True)
            )
            for index, part in zip(alike, cleaned, strict=True):
                found[index] = part
        return tiles.join(found).astype(np.float64)


def _shape(values: np.ndarray) -> np.ndarray:
    """A map over its mean, so that refreshes count alike in the memory whatever the loss has fallen to in between, or the units that
    variances are in; what is not finite is taken for nothing seen."""
    seen = np.where(np.isfinite(values), values, 0.0)
    return seen / (seen.mean() or 1.0)


def _together(maps: np.ndarray, clean: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """`clean` applied to maps (n, rows, columns, 3) side by side in one picture, since each call has its price. Mirrored margins keep
    them from seeing one another."""
    count, rows, columns, _ = maps.shape
    across = math.ceil(math.sqrt(count))
    down = math.ceil(count / across)
    margin = min(_MARGIN, rows, columns) if count > 1 else 0
    padded = np.pad(maps, [(0, 0), (margin, margin), (margin, margin), (0, 0)], mode="symmetric")
    padded = np.concatenate([padded, np.zeros((across * down - count, *padded.shape[1:]))])
    height, width = padded.shape[1:3]
    picture = padded.reshape(down, across, height, width, 3).swapaxes(1, 2).reshape(down * height, across * width, 3)
    scale = float(picture.max()) or 1.0
    cleaned = (
        clean(picture / scale).reshape(down, height, across, width, 3).swapaxes(1, 2).reshape(-1, height, width, 3)
    )
    return cleaned[:count, margin : margin + rows, margin : margin + columns] * scale
