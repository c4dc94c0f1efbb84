"""The films of all views divided into square tiles, on which pixel probabilities are estimated and from which pixels are drawn.

All pixels of a tile are equally likely. The cost of estimating and drawing grows with the number of tiles, not of pixels, so it does
not depend on the number and size of the images.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.scene.batches import PixelSample
from unrender.scene.problem import Problem

MOST_TILES = 1 << 24
_RANGE = 1 << 32


@dataclass(frozen=True)
class Grid:
    """The tiles of one view, row by row: `rows` × `columns`, `side` pixels wide but for the last of a row or column."""

    rows: int
    columns: int
    side: int


@dataclass(frozen=True)
class Tiles:
    """Tiles of all views, concatenated view by view; every array (tiles,), integers.

    Attributes:
        grids: one per view.
        views: index of the view.
        x, y: the first pixel.
        widths, heights: in pixels.
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
        """How many pixels each has."""
        return self.widths * self.heights

    def locate(self, views: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """The tile of each pixel.

        Args:
            views: index of the view, (N,).
            pixels: row-major index within its film, (N,).
        """
        starts = np.cumsum([0, *(grid.rows * grid.columns for grid in self.grids)])[:-1]
        columns, sides = np.array([(grid.columns, grid.side) for grid in self.grids]).T
        films = self.films[starts]
        row, column = np.divmod(pixels.astype(np.int64), films[views])
        side = sides[views]
        return starts[views] + row // side * columns[views] + column // side

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """(tiles, ...) to one array (rows, columns, ...) per view."""
        ends = np.cumsum([grid.rows * grid.columns for grid in self.grids])[:-1]
        parts = np.split(values, ends)
        return [
            part.reshape(grid.rows, grid.columns, *values.shape[1:])
            for part, grid in zip(parts, self.grids, strict=True)
        ]

    def join(self, maps: list[np.ndarray]) -> np.ndarray:
        """The inverse of `split`."""
        return np.concatenate([part.reshape(-1, *part.shape[2:]) for part in maps])

    def coarsen(self, values: np.ndarray, level: int) -> np.ndarray:
        """Means over blocks of 2^level × 2^level tiles, weighted by their numbers of pixels, repeated for each tile of the block.

        Args:
            values: (tiles, ...).
            level: 0 leaves `values` as they are.
        """
        if level == 0:
            return values
        found = []
        for part, size, grid in zip(self.split(values), self.split(self.sizes), self.grids, strict=True):
            rows, columns = np.arange(0, grid.rows, 2**level), np.arange(0, grid.columns, 2**level)
            weight = size.reshape(size.shape + (1,) * (part.ndim - 2)).astype(np.float64)
            sums, weights = (
                np.add.reduceat(np.add.reduceat(x, rows, axis=0), columns, axis=1) for x in (part * weight, weight)
            )
            means = (sums / weights).repeat(2**level, axis=0)[: grid.rows].repeat(2**level, axis=1)
            found.append(means[:, : grid.columns])
        return self.join(found)


def cut(problem: Problem, most: int) -> Tiles:
    """The finest tiles of at most `most` in all, but one per view at least; of equal side in all views."""
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
        columns.append(
            [
                np.full(x.size, view),
                x,
                y,
                np.minimum(side, width - x),
                np.minimum(side, height - y),
                np.full(x.size, width),
            ]
        )
    return Tiles(tuple(grids), *(np.concatenate(parts) for parts in zip(*columns, strict=True)))


@dataclass(frozen=True)
class InverseCdfTable:
    """The inverse of the tiles' cumulative distribution, the unit interval as integers in [0, 2³²), so that probabilities are exact.

    Attributes:
        starts: the cumulative distribution before each tile, (tiles,), ascending.
        weights: 1 / p of a pixel of the tile, (tiles, 1).
        places: view, x, y, width, height, film width of each tile: (tiles,) each.
    """

    starts: Array
    weights: Array
    places: tuple[Array, Array, Array, Array, Array, Array]

    @classmethod
    def of(cls, tiles: Tiles, probabilities: np.ndarray, array: Callable[[np.ndarray], Array]) -> InverseCdfTable:
        """From the tiles' probabilities (tiles,), all above 0; rounded to multiples of 2⁻³², never to 0.

        Args:
            tiles: to draw from.
            probabilities: of any positive sum.
            array: makes the renderer's arrays.
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
        """`count` pixels with replacement.

        Args:
            count: how many.
            key: of the random numbers.
            stratified: one draw from each of `count` equal strata of the unit interval, with a common random offset modulo 1: the
                marginal distribution of each draw is the table's. Otherwise all are independent.
        """
        number = _stratified(self.weights, count, key) if stratified else _independent(self.weights, count, key)
        tile = arrays.searchsorted(self.starts, number)
        return self._draw_within(tile, arrays.gather_rows(self.weights, tile) / count, key)

    def draw_per_tile(self, count: int, key: Key) -> PixelSample:
        """`count` pixels of every tile, consecutive; weights of 1."""
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
    if count == 1:  # one stratum, which is the whole interval: one integer more than 32 bits can count
        return _independent(like, 1, key)
    stride = _RANGE // count
    jitter = arrays.random_integers(like, key.fold(0).uint32(), count, stride)
    return arrays.arange(like, count) * stride + jitter + arrays.integer(key.fold(1).uint32(), like)


FACTORS = 2
"""The maps of which the samples of a step tell: second moments of the parameter derivatives, and of the loss derivative."""

Maps = tuple[np.ndarray, ...]
"""Statistics of each tile and channel, (tiles, 3) each."""


@dataclass(frozen=True)
class TileSamples:
    """What some paths tell.

    Attributes:
        tile: of each sample, (N,).
        values: per map, (N, 3).
        weights: one over the probability of each sample's pixel relative to that of the others, (N,).
        paths: behind each sample, a number or (N,).
    """

    tile: np.ndarray
    values: Maps
    weights: np.ndarray
    paths: float | np.ndarray = 1.0

    def normalised(self) -> Maps:
        """The values over their mean over all pixels, so that samples count alike whatever the loss or the units of its variance have
        become in between."""
        means = [float(np.average(value.mean(axis=1), weights=self.weights)) for value in self.values]
        return tuple(value / (mean or 1.0) for value, mean in zip(self.values, means, strict=True))

    def summed(self, values: np.ndarray, tiles: int) -> tuple[np.ndarray, np.ndarray]:
        """Sums and numbers of paths per tile, (tiles, 3) and (tiles,)."""
        paths = np.broadcast_to(np.asarray(self.paths, np.float64), self.tile.shape)
        sums = [np.bincount(self.tile, value * paths, tiles) for value in values.T]
        return np.stack(sums, axis=1), np.bincount(self.tile, paths, tiles)

    def judged(self, values: Maps, denoised: Maps) -> np.ndarray:
        """`uniform_share.observed`'s samples: each factor of Eq. 12 by the samples, times the other by the map, (2, N)."""
        factors = [
            (values[index] * denoised[1 - index][self.tile]).sum(axis=1) * self.weights for index in range(FACTORS)
        ]
        return np.stack(factors) / self.weights.sum()


def finite(values: np.ndarray) -> np.ndarray:
    """Values that are not finite count as zeros."""
    return np.where(np.isfinite(values), values, 0.0)
