"""Denoising of the maps from which an importance map is computed."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from unrender.images import denoising
from unrender.pixels.tiles import Tiles


def pool(tiles: Tiles, means: np.ndarray, counts: np.ndarray, prior: float) -> np.ndarray:
    """Shrink the means of tiles towards those of surrounding blocks, according to their number of paths:

        m̂_b = (n_b m_b + κ m̂_parent(b)) / (n_b + κ),

    from all views together down to one view, blocks of 2^d × 2^d tiles, and single tiles. A tile of many paths keeps its own mean. A tile
    of few paths gets that of the smallest block with about κ paths. So a single bright path raises its surroundings, and a tile without a
    bright path is not mistaken for dark.

    Args:
        means: (tiles, C).
        counts: n, number of paths of each tile, (tiles,), >= 0.
        prior: κ > 0, in paths.

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
    """Return the sums over blocks of 2 × 2."""
    rows, columns = np.arange(0, x.shape[0], 2), np.arange(0, x.shape[1], 2)
    return np.add.reduceat(np.add.reduceat(x, rows, axis=0), columns, axis=1)


MapDenoiser = Literal["auto", "oidn", "optix", "pooling", "variation", "none"]
MAP_DENOISERS: tuple[MapDenoiser, ...] = ("auto", "oidn", "optix", "pooling", "variation", "none")

_MARGIN = 4
"""Tiles of padding around each map if several are denoised in one image."""

_PRIOR = 64.0
"""Number of paths at which a tile's own mean weighs as much as its surroundings."""


def denoise_map(tiles: Tiles, values: np.ndarray, by: MapDenoiser, counts: np.ndarray) -> np.ndarray:
    """Denoise a map (tiles, 3), with the tiles of each view as an image; unchanged for "none".

    Args:
        values: mean over each tile's paths.
        by: "auto" is optix on a GPU, oidn if it is installed, else pooling (`pool`). Pooling spreads single bright paths, which dominate
            second moments, without losing them.
        counts: number of paths of each tile, (tiles,).
    """
    if by == "none":
        return values
    if by == "auto" and denoising.optix_problem() is not None:
        by = "oidn" if importlib.util.find_spec("pyoidn") else "pooling"
    if by == "pooling":
        return pool(tiles, values, counts, _PRIOR)
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
    """Apply `denoise` to maps (n, rows, columns, 3) side by side in one image, because each call has a fixed cost.

    Mirrored margins prevent the filter from mixing neighbouring maps.
    """
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
