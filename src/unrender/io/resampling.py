"""Resampling of textures and grids by Mitsuba's convention: values are at texel centres, and vary linearly between them."""

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
    """Resize (*old, C) to (*size, C): `downsample` along axes that shrink, then `upsample` along axes that grow."""
    least = [min(old, new) for old, new in zip(values.shape[:-1], size, strict=True)]
    return np.ascontiguousarray(upsample(downsample(values, least), size), np.float32)
