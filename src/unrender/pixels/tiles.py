"""The films of all views, cut into square cells: what probabilities are estimated on, and drawn from.

All pixels of a cell are equally likely. Estimating and drawing cost what there are cells, not pixels: the price of a step does
not depend on how large the pictures are, or how many.
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
from unrender.problem.batches import PixelSample
from unrender.problem.problem import Problem

MOST_CELLS = 1 << 24
_RANGE = 1 << 32


@dataclass(frozen=True)
class Grid:
    """The cells of one view, row by row: `rows` × `columns`, `side` pixels wide but for the last of a row or column."""

    rows: int
    columns: int
    side: int


@dataclass(frozen=True)
class Tiles:
    """Cells of all views, one view behind the other; every array (cells,), whole numbers.

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

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """(cells, ...) to one array (rows, columns, ...) per view."""
        ends = np.cumsum([grid.rows * grid.columns for grid in self.grids])[:-1]
        parts = np.split(values, ends)
        return [
            part.reshape(grid.rows, grid.columns, *values.shape[1:])
            for part, grid in zip(parts, self.grids, strict=True)
        ]

    def join(self, maps: list[np.ndarray]) -> np.ndarray:
        """The inverse of `split`."""
        return np.concatenate([part.reshape(-1, *part.shape[2:]) for part in maps])

    def coarser(self, values: np.ndarray, level: int) -> np.ndarray:
        """Means over blocks of 2^level × 2^level cells, weighted by their pixels, given back to each cell of the block.

        Args:
            values: (cells, ...).
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
    """The finest cells of at most `most` in all, but one per view at least: their sides are equal in all views."""
    return _cut(tuple(problem.renderer.resolutions()[view.sensor] for view in problem.views), min(most, MOST_CELLS))


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
    """Where draws fall: the unit interval as [0, 2³²), a run of whole numbers for each cell, so that probabilities are exact.

    Attributes:
        starts: of each cell's run, (cells,), ascending.
        weights: a pixel's 1 / p, (cells, 1).
        places: view, x, y, width, height, film width of each cell: (cells,) each.
    """

    starts: Array
    weights: Array
    places: tuple[Array, Array, Array, Array, Array, Array]

    @classmethod
    def of(cls, tiles: Tiles, probabilities: np.ndarray, array: Callable[[np.ndarray], Array]) -> InverseCdfTable:
        """Of the cells' probabilities (cells,), all above 0; rounded to multiples of 2⁻³², never to 0.

        Args:
            cells: where.
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
            stratified: one draw from each of `count` equal parts of the unit interval, turned by a common random offset; each draw
                has the table's probabilities all the same, but they spread evenly. Otherwise all are independent.
        """
        number = _stratified(self.weights, count, key) if stratified else _independent(self.weights, count, key)
        cell = arrays.searchsorted(self.starts, number)
        return self._within(cell, arrays.gather_rows(self.weights, cell) / count, key)

    def one_of_each(self, count: int, key: Key) -> PixelSample:
        """`count` pixels of every cell, side by side; weights of 1."""
        cell = arrays.arange(self.weights, arrays.shape(self.weights)[0] * count) // count
        return self._within(cell, arrays.gather_rows(self.weights * 0 + 1, cell), key)

    def _within(self, cell: Array, weights: Array, key: Key) -> PixelSample:
        view, x, y, width, height, film = (arrays.gather(place, cell) for place in self.places)
        column = x + arrays.random_below(width, self.weights, key.fold(2).uint32())
        row = y + arrays.random_below(height, self.weights, key.fold(3).uint32())
        draw = PixelSample(view, row * film + column, weights)
        arrays.evaluate(draw.views, draw.pixels, draw.weights)
        return draw


def _independent(like: Array, count: int, key: Key) -> Array:
    high = arrays.random_integers(like, key.fold(0).uint32(), count, 1 << 16)
    return high * (1 << 16) + arrays.random_integers(like, key.fold(1).uint32(), count, 1 << 16)


def _stratified(like: Array, count: int, key: Key) -> Array:
    stride = _RANGE // count
    within = arrays.random_integers(like, key.fold(0).uint32(), count, stride)
    return arrays.arange(like, count) * stride + within + arrays.integer(key.fold(1).uint32(), like)
