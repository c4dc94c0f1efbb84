"""Per-tile statistics of the loss derivative and of the squared parameter derivatives of pixels from a few paths, and their denoising.

This is stage 1 of the algorithm of "Image-space Adaptive Sampling for Fast Inverse Rendering".
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.images import denoising
from unrender.pixels.tiles import InverseCdfTable, Tiles
from unrender.rendering.renderer import CountingSession
from unrender.scene.batches import PixelBatch, PixelSample
from unrender.scene.problem import Problem


def pool(tiles: Tiles, means: np.ndarray, counts: np.ndarray, prior: float = 64.0) -> np.ndarray:
    """Shrink the means of tiles towards those of surrounding blocks, according to their number of paths:

        m̂_b = (n_b m_b + κ m̂_parent(b)) / (n_b + κ),

    from all views together down to one view, blocks of 2^d × 2^d tiles, and single tiles. A tile of many paths keeps its own mean. A tile
    of few paths gets that of the smallest block with about κ paths. So a single bright path raises its surroundings, and a tile without a
    bright path is not mistaken for dark.

    Args:
        means: (tiles, C).
        counts: n, number of paths of each tile, (tiles,), >= 0.
        prior: κ > 0, in paths: the number at which a tile's own mean weighs as much as its surroundings.

    Returns:
        (tiles, C); zeros if no tile has a path.
    """
    counts = counts[:, None]
    sums = means * counts
    overall = sums.sum(axis=0) / max(float(counts.sum()), 1e-30)
    estimates = []
    for total, count in zip(tiles.split(sums), tiles.split(counts), strict=True):
        levels = [(total, count)]
        while max(levels[-1][0].shape[:2]) > 1:
            levels.append((_halved(levels[-1][0]), _halved(levels[-1][1])))
        estimate = np.broadcast_to(overall, (1, 1, len(overall)))
        for sum_, weight in reversed(levels):
            rows, columns = sum_.shape[:2]
            parent = estimate.repeat(2, axis=0)[:rows].repeat(2, axis=1)[:, :columns]
            estimate = (sum_ + prior * parent) / (weight + prior)
        estimates.append(estimate)
    return tiles.join(estimates)


def _halved(x: np.ndarray) -> np.ndarray:
    rows, columns = np.arange(0, x.shape[0], 2), np.arange(0, x.shape[1], 2)
    return np.add.reduceat(np.add.reduceat(x, rows, axis=0), columns, axis=1)


MapDenoiser = Literal["auto", "oidn", "optix", "pooling", "variation", "none"]

_MARGIN = 4  # tiles of padding around each map if several are denoised in one image


def denoise_map(tiles: Tiles, values: np.ndarray, by: MapDenoiser, counts: np.ndarray) -> np.ndarray:
    """Denoise a map (tiles, 3), means over the numbers of paths (tiles,), with the tiles of each view as an image; unchanged for "none".

    "auto" is optix on a GPU, oidn if it is installed, else pooling (`pool`). Pooling spreads single bright paths, which dominate second
    moments, without losing them.
    """
    if by == "none":
        return values
    if by == "auto" and denoising.optix_problem() is not None:
        by = "oidn" if importlib.util.find_spec("pyoidn") else "pooling"
    if by == "pooling":
        return pool(tiles, values, counts)
    maps = tiles.split(values)
    denoised: list[np.ndarray] = [np.empty(0)] * len(maps)
    for shape in {part.shape for part in maps}:
        same_shape = [index for index, part in enumerate(maps) if part.shape == shape]
        results = denoise_side_by_side(
            np.stack([maps[index] for index in same_shape]), lambda x: denoising.denoise(x, by=by, fast=True)
        )
        for index, part in zip(same_shape, results, strict=True):
            denoised[index] = part
    return tiles.join(denoised).astype(np.float64)


def denoise_side_by_side(maps: np.ndarray, denoise: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Apply `denoise` to maps (n, rows, columns, 3) in one image, since each call has a fixed cost, with mirrored margins between them."""
    count, rows, columns, _ = maps.shape
    across = math.ceil(math.sqrt(count))
    down = math.ceil(count / across)
    margin = min(_MARGIN, rows, columns) if count > 1 else 0
    padded = np.pad(maps, [(0, 0), (margin, margin), (margin, margin), (0, 0)], mode="symmetric")
    padded = np.concatenate([padded, np.zeros((across * down - count, *padded.shape[1:]))])
    height, width = padded.shape[1:3]
    image = padded.reshape(down, across, height, width, 3).swapaxes(1, 2).reshape(down * height, across * width, 3)
    scale = float(image.max()) or 1.0
    denoised = (
        denoise(image / scale).reshape(down, height, across, width, 3).swapaxes(1, 2).reshape(-1, height, width, 3)
    )
    return denoised[:count, margin : margin + rows, margin : margin + columns] * scale


ROUNDS = 16
"""Maximum number of sign patterns of an estimate. Products of different derivatives average to zero over patterns; squares remain."""


_DECAY = 0.9  # decay of the running mean of the gradient's squares

_FLOOR, _LEAST = 0.1, 1e-30
"""Lower bounds of an element's second moment: relative to the typical one of its parameter, and absolute."""


_COST_PRIOR = 4.0
"""Number of paths at which a tile's own cost weighs as much as its surroundings. Numbers of vertices vary little."""


@dataclass(frozen=True)
class PixelStatistics:
    """Statistics from a few paths per tile; every map is (tiles, 3), float64, the mean over the tile's pixels.

    Attributes:
        magnitudes: per level, E|∂L/∂I|.
        squares: per level, E[(∂L/∂I)²].
        second_moment: Σ_k E[(∂I/∂θ_k)²]; (0, 3) without tangents.
        samples: number of paths traced.
    """

    magnitudes: tuple[np.ndarray, ...]
    squares: tuple[np.ndarray, ...]
    second_moment: np.ndarray
    samples: int


@dataclass(frozen=True)
class PilotRequest:
    """Request for one path through each pixel of a sample, for `Problem.executor`.

    Attributes:
        sample: Pixels, with weights of 1.
        key: Key of the random numbers.
        references: Further references, (N, 3) each, with which the paths are compared.
        tangents: Tangents of the parameters; {} for none.
    """

    parameters: Tree
    sample: PixelSample
    key: Key
    references: tuple[Array, ...]
    tangents: Tree

    def carry_out(self, problem: Problem) -> list[np.ndarray]:
        """Trace one path through each pixel of the sample, in this process.

        Returns:
            (N, 3) each: the loss derivative at the pixels' own references, at each of `references`, and, with tangents, the squared
            derivative along them.
        """
        batch = PixelBatch(problem, self.sample)
        session = problem.renderer.prepare(list(self.parameters), None)
        rendering = session.image(self.parameters, batch.request(1, self.key.uint32()))
        image = rendering.images[0]
        _, factor = batch.targets
        results = [batch.loss_derivative(image)]
        results += [problem.loss.derivative(image, reference) * factor for reference in self.references]
        if self.tangents:
            results.append(session.tangent_moment(self.parameters, rendering.paths, self.tangents))
        arrays.evaluate(results)
        return [arrays.numpy(x) for x in results]


def reference_means(problem: Problem, tiles: Tiles) -> np.ndarray:
    """Return the mean reference of each tile, float32 (tiles, 3)."""
    means = []
    for view, grid in zip(problem.views, tiles.grids, strict=True):
        image = np.asarray(view.reference)
        rows, columns = np.arange(grid.rows) * grid.side, np.arange(grid.columns) * grid.side
        sums = np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)
        sizes = np.outer(np.diff([*rows, image.shape[0]]), np.diff([*columns, image.shape[1]]))
        means.append(sums / sizes[..., None])
    return tiles.join(means).astype(np.float32)


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
    """Estimate statistics from `spp` paths per tile, each through a random pixel of it.

    Args:
        problem, parameters: what to render.
        uniform_table: table of these tiles with equal pixel probabilities.
        spp: paths per tile, >= 1.
        key: key of the random numbers.
        references: per level from 1 on, the reference of each tile, (tiles, 3); level 0 uses the pixels' own.
        scales: scales of the tangents of v (`scene.coordinates`); {} for no tangents. Tangents are propagated in up to `ROUNDS` rounds
            with separate signs, because all paths of a launch share them.
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
        means(-1, np.asarray) if scales else np.empty((0, 3)),
        len(tiles.views) * spp * (2 if scales else 1),
    )


def costs(
    problem: Problem, parameters: Tree, tiles: Tiles, uniform_table: InverseCdfTable, key: Key
) -> tuple[np.ndarray, int]:
    """Return the cost of a path through each tile relative to one without an intersection, (tiles,), >= 1, and the number of paths traced.

    The cost is 1 + v / 2 for v vertices, each of which adds a segment and a connection to an emitter. (On a processor, a path that leaves
    the scene costs as much as half a vertex in mini-batches of 16384 pixels. In batches of 2048, where launches dominate, it costs as much
    as four.) It is estimated from one path per tile, and pooled. Ones if the renderer does not count vertices.
    """
    session = problem.renderer.prepare(list(parameters), None)
    if not isinstance(session, CountingSession):
        return np.ones(len(tiles.views)), 0
    batch = PixelBatch(problem, uniform_table.draw_per_tile(1, key.fold(0)))
    vertices = arrays.numpy(session.vertices(parameters, batch.request(1, key.fold(1).uint32())))
    means = pool(tiles, vertices[:, :1].astype(np.float64), np.ones(len(tiles.views)), _COST_PRIOR)
    return 1 + means[:, 0] / 2, len(tiles.views)


def _round(
    problem: Problem,
    parameters: Tree,
    uniform_table: InverseCdfTable,
    spp: int,
    key: Key,
    references: list[Array],
    scales: Tree,
) -> list[np.ndarray]:
    """Return, per path, (tiles * spp, 3): the loss derivative on each level and, last, the squared derivative along the tangents.

    If the problem's views are distributed, the workers trace the paths.
    """
    sample = uniform_table.draw_per_tile(spp, key.fold(0))
    count = arrays.shape(sample.weights)[0]
    tile = arrays.arange(sample.weights, count) // spp
    own = tuple(arrays.gather_rows(reference, tile) for reference in references)
    tangents: Tree = {}
    if scales:
        tangents = random_tangents(problem, parameters, scales, key.fold(2))
    request = PilotRequest(parameters, sample, key.fold(1), own, tangents)
    return problem.executor.trace_pilot(problem, request)


def random_tangents(problem: Problem, parameters: Tree, scales: Tree, key: Key) -> Tree:
    """Return the tangents of the parameters for tangents of v (`scene.coordinates`), which are `scales` times random signs."""
    signs = random_signs(parameters, key)
    scaled = {name: scales[name] * problem.renderer.array(sign) for name, sign in signs.items()}
    return problem.coordinates.push_forward(scaled, problem.coordinates.slopes(parameters))


def random_signs(like: Tree, key: Key) -> dict[str, np.ndarray]:
    """Return independent random signs ±1 for every element of every parameter."""
    rng = np.random.default_rng(key.uint32())
    return {name: rng.choice(np.array([-1.0, 1.0]), size=shape) for name, shape in trees.shapes(like).items()}


def observed(problem: Problem, second_moment: Tree, gradient: Tree) -> Tree:
    """Return the running mean square of the gradient with respect to v, after one with respect to u, whose non-finite elements are 0."""
    pulled = problem.coordinates.pull_back(gradient, {})
    squares = trees.map(lambda g: arrays.where(arrays.is_finite(g), g * g, 0.0), pulled)
    if not second_moment or trees.shapes(second_moment) != trees.shapes(squares):
        return squares
    return trees.map(lambda old, new: old * _DECAY + new * (1 - _DECAY), second_moment, squares)


def scales(parameters: Tree, second_moment: Tree) -> Tree:
    """Return the scale of each element's derivative.

    It is one, or, with known mean squared gradients, 1 / √(m n) for an element's mean square m and the number n of its parameter's
    elements, so that a colour counts as much as a texture. A tenth of the parameter's typical second moment, the geometric mean over
    non-zero elements, is added as a floor. It bounds the scale of elements that hardly any path has hit. (A few bright paths would
    dominate the arithmetic mean.)
    """
    if not second_moment or trees.shapes(second_moment) != trees.shapes(parameters):
        return trees.map(lambda x: x * 0.0 + 1.0, parameters)

    def scale(x: Array) -> Array:
        nonzero = arrays.where(x > 0, x * 0.0 + 1.0, x * 0.0)
        logarithms = arrays.log(arrays.maximum(x, _LEAST)) * nonzero
        typical = arrays.exp(arrays.total(logarithms) / arrays.maximum(arrays.total(nonzero), 1.0))
        return 1.0 / arrays.sqrt((x + typical * _FLOOR + _LEAST) * float(math.prod(arrays.shape(x))))

    return trees.map(scale, second_moment)
