"""What pixels bring to the gradient's variance, estimated from few paths on cells of pixels (Stage 1 of the method's algorithm)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.pixels.tiles import InverseCdfTable, Tiles
from unrender.problem.batches import PixelBatch
from unrender.problem.problem import Problem

ROUNDS = 16
"""Sign patterns of an estimate at most: the squares of single derivatives are what is left when their products average out."""


_FLOOR, _LEAST = 0.1, 1e-30
"""Of an element's energy: in shares of its parameter's typical one, and at all."""


@dataclass(frozen=True)
class PixelStatistics:
    """What a few paths in each cell tell; every map (cells, 3), float64, means over the cell's pixels.

    Attributes:
        sizes: per level, E|∂L/∂I|.
        squares: per level, E[(∂L/∂I)²].
        moments: Σ_k E[(∂I/∂θ_k)²]; None where not asked for.
        samples: paths traced.
    """

    sizes: tuple[np.ndarray, ...]
    squares: tuple[np.ndarray, ...]
    moments: np.ndarray | None
    samples: int


def reference_means(problem: Problem, tiles: Tiles) -> np.ndarray:
    """The mean reference of each cell, float32 (cells, 3)."""
    found = []
    for view, grid in zip(problem.views, tiles.grids, strict=True):
        picture = np.asarray(view.reference)
        rows, columns = np.arange(grid.rows) * grid.side, np.arange(grid.columns) * grid.side
        sums = np.add.reduceat(np.add.reduceat(picture, rows, axis=0), columns, axis=1)
        sizes = np.outer(
            np.diff([*rows, picture.shape[0]]),
            np.diff([*columns, picture.shape[1]]),
        )
        found.append(sums / sizes[..., None])
    return tiles.join(found).astype(np.float32)


def estimate_statistics(
    problem: Problem,
    parameters: Tree,
    tiles: Tiles,
    uniform_table: InverseCdfTable,
    spp: int,
    key: Key,
    references: list[Array],
    scales: Tree,
) -> PixelStatistics:
    """Trace `spp` paths in each cell, each through a pixel of its own.

    Args:
        problem, parameters: where.
        cells: of all views.
        spots: a table of these cells.
        spp: paths per cell, >= 1.
        key: of the random numbers.
        references: per level from 1 on, what the cell's paths are compared with there, (cells, 3); at level 0 it is the pixel's own.
        scales: of the tangents, in the coordinates of the descent; empty to carry none. They are carried in up to `ROUNDS` rounds, each
            with signs of its own, since all paths of a launch share them.
    """
    rounds = max(n for n in range(1, min(spp, ROUNDS) + 1) if spp % n == 0) if scales else 1
    parts = [
        _round(problem, parameters, uniform_table, spp // rounds, key.fold(index), references, scales)
        for index in range(rounds)
    ]

    def means(index: int, of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        values = [of(part[index].astype(np.float64)).reshape(len(tiles.views), -1, 3).mean(axis=1) for part in parts]
        return np.mean(values, axis=0)

    levels = range(1 + len(references))
    return PixelStatistics(
        tuple(means(level, np.abs) for level in levels),
        tuple(means(level, np.square) for level in levels),
        means(-1, np.asarray) if scales else None,
        len(tiles.views) * spp * (2 if scales else 1),
    )


def _round(
    problem: Problem,
    parameters: Tree,
    uniform_table: InverseCdfTable,
    spp: int,
    key: Key,
    references: list[Array],
    scales: Tree,
) -> list[np.ndarray]:
    """Per path (cells * spp, 3): the loss derivative on each level and, last, the squared derivative along the tangents."""
    batch = PixelBatch(problem, uniform_table.one_of_each(spp, key.fold(0)))
    session = problem.renderer.prepare(list(parameters), None)
    rendering = session.image(parameters, batch.request(1, key.fold(1).uint32()))
    image = rendering.images[0]
    _, factor = batch.targets
    found = [batch.loss_derivative(image)]
    for reference in references:
        own = arrays.gather_rows(reference, arrays.arange(image, batch.pixels) // spp)
        found.append(problem.loss.derivative(image, own) * factor)
    if scales:
        signs = random_signs(parameters, key.fold(2))
        tangents = problem.precondition(
            {name: scales[name] * problem.renderer.array(sign) for name, sign in signs.items()}
        )
        found.append(session.tangent_moment(parameters, rendering.paths, tangents))
    arrays.evaluate(found)
    return [arrays.numpy(x) for x in found]


def random_signs(like: Tree, key: Key) -> dict[str, np.ndarray]:
    """±1 for every element of every parameter, all independent."""
    rng = np.random.default_rng(key.uint32())
    return {name: rng.choice(np.array([-1.0, 1.0]), size=shape) for name, shape in trees.shapes(like).items()}


def scales(parameters: Tree, second_moment: Tree) -> Tree:
    """What an element's derivative is multiplied by: one, or, where mean squared gradients are known, one over the root of its own times
    the elements of its parameter, so that a colour counts as much as a texture.

    Elements that hardly any path has met yet do not count as much as they might: a tenth of their parameter's typical energy is added,
    the geometric mean of those met. (The mean would be that of a few elements that saw a rare bright path.)
    """
    if not second_moment or trees.shapes(second_moment) != trees.shapes(parameters):
        return trees.map(lambda x: x * 0.0 + 1.0, parameters)

    def scale(x: Array) -> Array:
        met = arrays.where(x > 0, x * 0.0 + 1.0, x * 0.0)
        logarithms = arrays.log(arrays.maximum(x, _LEAST)) * met
        typical = arrays.exp(arrays.total(logarithms) / arrays.maximum(arrays.total(met), 1.0))
        return 1.0 / arrays.sqrt((x + typical * _FLOOR + _LEAST) * float(math.prod(arrays.shape(x))))

    return trees.map(scale, second_moment)
