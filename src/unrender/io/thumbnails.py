"""Smaller copies of pictures, textures and volumes, for people to look at."""

from __future__ import annotations

import numpy as np


def resize_nearest(coarse: np.ndarray, height: int, width: int) -> np.ndarray:
    """(rows, columns, ...) as (height, width, ...), each pixel that of the place it lies in."""
    rows, columns = (np.arange(n) * m // n for n, m in zip((height, width), coarse.shape[:2], strict=True))
    return coarse[rows][:, columns]


def reduced(array: np.ndarray, largest: int, axes: int = 2) -> np.ndarray:
    """Box-filtered by a whole factor so that none of the first `axes` sides is longer than `largest`.

    Edges are repeated where the factor does not divide a side. The array itself where it is small enough.
    """
    sides = array.shape[:axes]
    factor = -(-max(sides, default=0) // largest)
    if factor <= 1:
        return array
    # A side shorter than the factor, such as that of a strip, is averaged as a whole.
    factors = [min(factor, side) for side in sides]
    pad = [(0, -side % own) for side, own in zip(sides, factors, strict=True)] + [(0, 0)] * (array.ndim - axes)
    padded = np.pad(array, pad, mode="edge")
    blocks = [n for side, own in zip(padded.shape, factors, strict=False) for n in (side // own, own)]
    return padded.reshape(*blocks, *array.shape[axes:]).mean(axis=tuple(range(1, 2 * axes, 2)))
