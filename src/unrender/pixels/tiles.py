"""Square tiles of the films of all views, on which pixel probabilities are estimated and from which pixels are sampled.

All pixels of a tile are equally likely. The cost of estimation and sampling depends on the number of tiles, not of pixels, and thus not
on the number and size of the images.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem

MOST_TILES = 1 << 24
"""Maximum number of tiles of all views."""
_RANGE = 1 << 32


@dataclass(frozen=True)
class Grid:
    """Tiles of one view in row-major order: `rows` × `columns`, `side` pixels wide except at the right and lower border."""

    rows: int
    columns: int
    side: int


@dataclass(frozen=True)
class Tiles:
    """Tiles of all views, concatenated; every array is (tiles,), integers.

    Attributes:
        grids: one grid per view.
        views: index of the view.
        x, y: first pixel.
        widths, heights: size in pixels.
        films: width of the view's film.
    """

    grids: tuple[Grid, ...]
    views: np.ndarray
    x: np.ndarray
    y: np.ndarray
    widths: np.ndarray
    heights: np.ndarray
    films: np.ndarray

    @property
    def sizes(self) -> np.ndarray:
        """Number of pixels of each tile."""
        return self.widths * self.heights

    def locate(self, views: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return the tile index of each pixel.

        Args:
            views: index of the view, (N,).
            pixels: row-major index in its film, (N,).
        """
        starts = np.cumsum([0, *(grid.rows * grid.columns for grid in self.grids)])[:-1]
        columns, sides = np.array([(grid.columns, grid.side) for grid in self.grids]).T
        films = self.films[starts]
        row, column = np.divmod(pixels.astype(np.int64), films[views])
        side = sides[views]
        return starts[views] + row // side * columns[views] + column // side

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Split (tiles, ...) into one array (rows, columns, ...) per view."""
        ends = np.cumsum([grid.rows * grid.columns for grid in self.grids])[:-1]
        parts = np.split(values, ends)
        return [
            part.reshape(grid.rows, grid.columns, *values.shape[1:])
            for part, grid in zip(parts, self.grids, strict=True)
        ]

    def join(self, maps: list[np.ndarray]) -> np.ndarray:
        """Concatenate maps of all views; the inverse of `split`."""
        return np.concatenate([part.reshape(-1, *part.shape[2:]) for part in maps])

    def coarsen(self, values: np.ndarray, level: int) -> np.ndarray:
        """Return means over blocks of 2^level × 2^level tiles, weighted by their numbers of pixels, and repeated for each tile of the
        block.

        Args:
            values: (tiles, ...).
            level: number of doublings; 0 returns `values`.
        """
        if level == 0:
            return values
        means_per_view = []
        for part, size, grid in zip(self.split(values), self.split(self.sizes), self.grids, strict=True):
            rows, columns = np.arange(0, grid.rows, 2**level), np.arange(0, grid.columns, 2**level)
            weight = size.reshape(size.shape + (1,) * (part.ndim - 2)).astype(np.float64)
            sums, weights = (
                np.add.reduceat(np.add.reduceat(x, rows, axis=0), columns, axis=1) for x in (part * weight, weight)
            )
            means = (sums / weights).repeat(2**level, axis=0)[: grid.rows].repeat(2**level, axis=1)
            means_per_view.append(means[:, : grid.columns])
        return self.join(means_per_view)


def cut(problem: Problem, most: int) -> Tiles:
    """Return the finest tiles with at most min(`most`, `MOST_TILES`) in total, but at least one per view. All have the same side."""
    return _cut(tuple(problem.renderer.resolutions()[view.sensor] for view in problem.views), min(most, MOST_TILES))


@functools.lru_cache(maxsize=16)
def _cut(resolutions: tuple[tuple[int, int], ...], most: int) -> Tiles:
    def count(side: int) -> int:
        return sum(math.ceil(height / side) * math.ceil(width / side) for height, width in resolutions)

    side = max(1, math.isqrt(max(1, sum(height * width for height, width in resolutions) // max(most, 1))))
    while count(side) > max(most, len(resolutions)):
        side += 1
    columns: list[list[np.ndarray]] = []
    grids = []
    for view, (height, width) in enumerate(resolutions):
        grid = Grid(math.ceil(height / side), math.ceil(width / side), side)
        y, x = (part.reshape(-1) * side for part in np.mgrid[: grid.rows, : grid.columns])
        grids.append(grid)
        views, films = np.full(x.size, view), np.full(x.size, width)
        columns.append([views, x, y, np.minimum(side, width - x), np.minimum(side, height - y), films])
    return Tiles(tuple(grids), *(np.concatenate(parts) for parts in zip(*columns, strict=True)))


@dataclass(frozen=True)
class InverseCdfTable:
    """Inverse of the tiles' cumulative distribution. The unit interval is represented by integers in [0, 2³²), so probabilities are exact.

    Attributes:
        starts: cumulative distribution before each tile, (tiles,), ascending.
        weights: 1 / p of a pixel of the tile, (tiles, 1).
        places: view, x, y, width, height and film width of each tile, (tiles,) each.
    """

    starts: Array
    weights: Array
    places: tuple[Array, Array, Array, Array, Array, Array]

    @classmethod
    def of(cls, tiles: Tiles, probabilities: np.ndarray, array: Callable[[np.ndarray], Array]) -> InverseCdfTable:
        """Build the table from the tiles' probabilities (tiles,), all positive; they are rounded to multiples of 2⁻³², never to 0.

        Args:
            probabilities: probabilities with any positive sum.
            array: function that makes arrays of the renderer.
        """
        shares = np.asarray(probabilities, np.float64)
        ends = np.rint(np.cumsum(shares / shares.sum()) * _RANGE).astype(np.int64)
        step = np.arange(len(ends))
        ends = np.maximum.accumulate(np.maximum(ends - step, 1)) + step
        ends = np.minimum(ends, _RANGE - step[::-1])
        ends[-1] = _RANGE
        starts = np.concatenate([[0], ends[:-1]])
        weights = array((tiles.sizes * (_RANGE / (ends - starts)))[:, None])
        places = (tiles.views, tiles.x, tiles.y, tiles.widths, tiles.heights, tiles.films)
        return cls(
            arrays.like_integers(starts, weights),
            weights,
            tuple(arrays.like_integers(place, weights) for place in places),  # pyright: ignore[reportArgumentType]
        )

    def draw(self, count: int, key: Key, stratified: bool) -> PixelSample:
        """Sample `count` pixels with replacement.

        Args:
            count: number of pixels.
            key: key of the random numbers.
            stratified: whether to take one sample in each of `count` equal strata of the unit interval, with a common random offset
                modulo 1. The marginal distribution of each sample is that of the table. Otherwise samples are independent.
        """
        number = _stratified(self.weights, count, key) if stratified else _independent(self.weights, count, key)
        tile = arrays.searchsorted(self.starts, number)
        return self._draw_within(tile, arrays.gather_rows(self.weights, tile) / count, key)

    def draw_per_tile(self, count: int, key: Key) -> PixelSample:
        """Sample `count` consecutive pixels of every tile, with weights of 1."""
        tile = arrays.arange(self.weights, arrays.shape(self.weights)[0] * count) // count
        return self._draw_within(tile, arrays.gather_rows(self.weights * 0 + 1, tile), key)

    def _draw_within(self, tile: Array, weights: Array, key: Key) -> PixelSample:
        view, x, y, width, height, film = (arrays.gather(place, tile) for place in self.places)
        column = x + arrays.random_below(width, self.weights, key.fold(2).uint32())
        row = y + arrays.random_below(height, self.weights, key.fold(3).uint32())
        sample = PixelSample(view, row * film + column, weights)
        arrays.evaluate(sample.views, sample.pixels, sample.weights)
        return sample


def _independent(like: Array, count: int, key: Key) -> Array:
    high = arrays.random_integers(like, key.fold(0).uint32(), count, 1 << 16)
    return high * (1 << 16) + arrays.random_integers(like, key.fold(1).uint32(), count, 1 << 16)


def _stratified(like: Array, count: int, key: Key) -> Array:
    if count == 1:  # the single stratum is the entire interval, whose size does not fit into 32 bits
        return _independent(like, 1, key)
    stride = _RANGE // count
    jitter = arrays.random_integers(like, key.fold(0).uint32(), count, stride)
    return arrays.arange(like, count) * stride + jitter + arrays.integer(key.fold(1).uint32(), like)


FACTORS = 2
"""Number of maps that a step's samples update: second moments of the parameter derivatives, and of the loss derivative."""

Maps = tuple[np.ndarray, ...]
"""Statistics of each tile and channel, (tiles, 3) each."""


@dataclass(frozen=True)
class TileSamples:
    """Statistics of some paths.

    Attributes:
        tile: tile index of each sample, (N,).
        values: value per map, (N, 3).
        weights: inverse of each sample's relative pixel probability, (N,).
        paths: number of paths of each sample, a number or (N,).
    """

    tile: np.ndarray
    values: Maps
    weights: np.ndarray
    paths: float | np.ndarray = 1.0

    def normalised(self) -> Maps:
        """Return the values divided by their mean over all pixels, so that samples count equally when the loss or its scale changes."""
        means = [float(np.average(value.mean(axis=1), weights=self.weights)) for value in self.values]
        return tuple(value / (mean or 1.0) for value, mean in zip(self.values, means, strict=True))

    def summed(self, values: np.ndarray, tiles: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums and numbers of paths per tile, (tiles, 3) and (tiles,)."""
        paths = np.broadcast_to(np.asarray(self.paths, np.float64), self.tile.shape)
        sums = [np.bincount(self.tile, value * paths, tiles) for value in values.T]
        return np.stack(sums, axis=1), np.bincount(self.tile, paths, tiles)

    def averaged(
        self, values: Maps, tiles: int, maps: Maps, counts: Sequence[np.ndarray]
    ) -> tuple[Maps, list[np.ndarray]]:
        """Return maps to which these values are added, and the number of paths of each tile and map. `maps` are empty before the first
        samples; those without values stay."""
        means, paths = list(maps), list(counts) if maps else []
        for index, value in enumerate(values):
            total, number = self.summed(value, tiles)
            if maps:
                total, number = total + maps[index] * counts[index][:, None], number + counts[index]
            means[index : index + 1] = [total / np.maximum(number, 1e-30)[:, None]]
            paths[index : index + 1] = [number]
        return tuple(means), paths

    def uniform_evidence(self, values: Maps, denoised: Maps) -> np.ndarray:
        """Return y of `uniform_share.observed`, (2, N): each factor of Eq. 12 from the samples, times the other one from the map."""
        factors = [
            (values[index] * denoised[1 - index][self.tile]).sum(axis=1) * self.weights for index in range(FACTORS)
        ]
        return np.stack(factors) / self.weights.sum()


def finite(values: np.ndarray) -> np.ndarray:
    """Replace values that are not finite by zeros."""
    return np.where(np.isfinite(values), values, 0.0)
