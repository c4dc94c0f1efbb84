"""What some paths tell of the tiles that they go through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["FACTORS", "Maps", "TileSamples", "finite"]

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
