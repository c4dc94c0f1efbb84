"""Smaller copies of images, textures and volumes for display."""

from __future__ import annotations

import numpy as np


def resize_nearest(coarse: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize (rows, columns, ...) to (height, width, ...) by nearest neighbour."""
    rows, columns = (np.arange(n) * m // n for n, m in zip((height, width), coarse.shape[:2], strict=True))
    return coarse[rows][:, columns]


def reduced(array: np.ndarray, largest: int, axes: int = 2) -> np.ndarray:
    """Reduce an array by box filtering with an integer factor, so that its first `axes` sides are at most `largest`.

    Borders are repeated if the factor does not divide a side. An array that is small enough is returned unchanged.
    """
    sides = array.shape[:axes]
    factor = -(-max(sides, default=0) // largest)
    if factor <= 1:
        return array
    # A side shorter than the factor, such as that of a strip, is averaged to a single value.
    factors = [min(factor, side) for side in sides]
    pad = [(0, -side % own) for side, own in zip(sides, factors, strict=True)] + [(0, 0)] * (array.ndim - axes)
    padded = np.pad(array, pad, mode="edge")
    blocks = [n for side, own in zip(padded.shape, factors, strict=False) for n in (side // own, own)]
    return padded.reshape(*blocks, *array.shape[axes:]).mean(axis=tuple(range(1, 2 * axes, 2)))
