"""Resampling of textures and grids by Mitsuba's convention, values at texel centres and linear between them; smaller copies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def upsample(values: np.ndarray, size: Sequence[int], wrap: Sequence[bool] = ()) -> np.ndarray:
    """Interpolate `values` linearly at the centres of finer texels.

    The map is linear in the values, and exact for linear functions at least half a coarse texel away from the borders. Beyond the borders
    values are constant (Mitsuba's `clamp`), or continue at the opposite end along axes that wrap (`repeat`). Results stay within the
    range of the values.

    Args:
        values: (*coarse, C).
        size: new number of texels along each axis but the last, not less than before.
        wrap: per axis, whether its two ends are neighbours; empty for no axis.
    """
    from scipy.ndimage import zoom

    result = values
    for axis, (old, new) in enumerate(zip(values.shape[:-1], size, strict=True)):
        if new != old:
            factors = [new / old if a == axis else 1.0 for a in range(values.ndim)]
            mode = "grid-wrap" if axis < len(wrap) and wrap[axis] else "nearest"
            result = zoom(result, factors, order=1, mode=mode, grid_mode=True)
    return np.asarray(result)


def downsample(values: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """Average over coarser texels, weighted by the overlap of each finer texel.

    Args:
        values: (*fine, C).
        size: new number of texels along each axis but the last, not more than before.
    """
    if values.shape[:-1] == tuple(size):
        return values
    from skimage.transform import resize_local_mean

    scaled = resize_local_mean(values, tuple(size), preserve_range=True, channel_axis=-1)
    return np.asarray(scaled, values.dtype)


def resize(values: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """Resize (*old, C) to (*size, C) float32: `downsample` along axes that shrink, then `upsample` along axes that grow."""
    least = [min(old, new) for old, new in zip(values.shape[:-1], size, strict=True)]
    return np.ascontiguousarray(upsample(downsample(values, least), size), np.float32)


def resize_nearest(coarse: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize (rows, columns, ...) to (height, width, ...) by nearest neighbour."""
    rows, columns = (np.arange(n) * m // n for n, m in zip((height, width), coarse.shape[:2], strict=True))
    return coarse[rows][:, columns]


def reduced(array: np.ndarray, largest: int, axes: int = 2) -> np.ndarray:
    """Box-filter an array by an integer factor, so that `axes` sides are at most `largest`. Borders are repeated; small arrays stay."""
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
