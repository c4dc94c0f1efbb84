"""Averages of tiles that few paths have met, pooled with those of the tiles around them."""

from __future__ import annotations

import numpy as np

from unrender.pixels.tiles import Tiles

__all__ = ["pool"]


def pool(tiles: Tiles, means: np.ndarray, counts: np.ndarray, prior: float) -> np.ndarray:
    """The means of tiles, each drawn towards that of the block around it by what is not known of it:

        m̂_b = (n_b m_b + κ m̂_parent(b)) / (n_b + κ),

    from all views together down to one view, blocks of 2^d × 2^d tiles, and single tiles. A tile of many paths keeps its own mean; one of
    few has that of the smallest block with about κ paths. So a single bright path raises its surroundings, and a tile where no path
    was bright is not taken for dark.

    Args:
        tiles: of all views.
        means: (tiles, C).
        counts: n, paths behind each, (tiles,), >= 0.
        prior: κ > 0, in paths.

    Returns:
        (tiles, C); zeros where no tile has a path.
    """
    counts = counts[:, None]
    sums = means * counts
    overall = sums.sum(axis=0) / max(float(counts.sum()), 1e-30)
    found = []
    for total, count in zip(tiles.split(sums), tiles.split(counts), strict=True):
        levels = [(total, count)]
        while max(levels[-1][0].shape[:2]) > 1:
            levels.append((_halved(levels[-1][0]), _halved(levels[-1][1])))
        estimate = np.broadcast_to(overall, (1, 1, len(overall)))
        for sum_, weight in reversed(levels):
            rows, columns = sum_.shape[:2]
            parent = estimate.repeat(2, axis=0)[:rows].repeat(2, axis=1)[:, :columns]
            estimate = (sum_ + prior * parent) / (weight + prior)
        found.append(estimate)
    return tiles.join(found)


def _halved(x: np.ndarray) -> np.ndarray:
    """Sums over blocks of 2 × 2."""
    rows, columns = np.arange(0, x.shape[0], 2), np.arange(0, x.shape[1], 2)
    return np.add.reduceat(np.add.reduceat(x, rows, axis=0), columns, axis=1)
