"""Textures and grids at other resolutions, by Mitsuba's convention: values sit at the middles of texels, and vary linearly between."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def upsample(values: np.ndarray, size: Sequence[int], wrap: Sequence[bool] = ()) -> np.ndarray:
    """The linear interpolant of `values` at the middles of finer texels.

    A linear map: exact for linear functions farther than half a coarse texel from the borders, where values are constant outwards
    (Mitsuba's `clamp`), or go on at the other end along axes that wrap (`repeat`). Never beyond the least and greatest value.

    Args:
        values: (*coarse, C).
        size: texels along each axis but the last, not fewer than there are.
        wrap: per axis, whether its two ends are neighbours; none for no axis.
    """
    from scipy.ndimage import zoom

    found = values
    for axis, (old, new) in enumerate(zip(values.shape[:-1], size, strict=True)):
        if new != old:
            factors = [new / old if a == axis else 1.0 for a in range(values.ndim)]
            mode = "grid-wrap" if axis < len(wrap) and wrap[axis] else "nearest"
            found = zoom(found, factors, order=1, mode=mode, grid_mode=True)
    return np.asarray(found)


def downsample(values: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """Means over the coarser texels, weighted by the share of each finer one that lies in them.

    Args:
        values: (*fine, C).
        size: texels along each axis but the last, not more than there are.
    """
    if values.shape[:-1] == tuple(size):
        return values
    from skimage.transform import resize_local_mean

    scaled = resize_local_mean(values, tuple(size), preserve_range=True, channel_axis=-1)
    return np.asarray(scaled, values.dtype)


def resize(values: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """(*old, C) to (*size, C): `downsample` along axes that shrink, then `upsample` along those that grow."""
    least = [min(old, new) for old, new in zip(values.shape[:-1], size, strict=True)]
    return np.ascontiguousarray(upsample(downsample(values, least), size), np.float32)
