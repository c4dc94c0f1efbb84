"""Edge-aware shrinkage of noisy maps: an à-trous decomposition whose details are kept as far as they are no noise.

The decomposition is that of Dammertz et al. 2010, "Edge-Avoiding À-Trous Wavelet Transform for fast Global Illumination Filtering", its
edges those of another map, the guide; the shrinkage is that of James and Stein 1961, "Estimation with Quadratic Loss".
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np

__all__ = ["details", "levels_of", "shrunk"]

_TAPS = {-1: 0.25, 0: 0.5, 1: 0.25}
"""Of the smoothing along an axis."""
_POOLED = 128 / 35
"""Independent numbers along an axis, of which a mean with the weights of the taps, applied twice, has the variance."""


def levels_of(grid: tuple[int, ...]) -> int:
    """The levels of detail of a grid: their spacing doubles from one texel to a quarter of the longest side."""
    return max(1, int(np.log2(max(grid))) - 1)


def shrunk(x: np.ndarray, noise: np.ndarray, guide: np.ndarray, wrap: Sequence[bool]) -> tuple[np.ndarray, list[float]]:
    """`x` with its details shrunk, and the mean share of each level that is kept, from the finest.

    With x_0 = x and F_l the smoothing at spacing 2^l, x_{l+1} = F_l x_l, the details d_l = x_l − x_{l+1} and what is left sum up to x:
    x = x_L + Σ d_l. The same maps, applied to a sample of the noise, give that of the details, e_l: of whatever correlation between texels.
    Then

        x̂ = x_L + Σ_l α_l d_l,   α_l = max(0, 1 − (p − 2) / (p + 2) · S² e_l² / S² d_l²)

    with means S² over neighbours at the same spacing and channels, of p numbers: James and Stein's factor for p means of one variance,
    itself estimated from p samples. Where noise falls to 0, x̂ is x; where all is noise, x̂ is smooth except along the guide's edges.

    Args:
        x: (*grid, channels).
        noise: a sample of the noise of x, of its shape: mean 0, and the covariance of x.
        guide: (*grid, channels of any number): neighbours are averaged as far as they are alike here.
        wrap: per axis, whether its two ends are neighbours.
    """
    grid, channels = x.shape[:-1], x.shape[-1]
    pooled = channels * _POOLED ** sum(size > 1 for size in grid)
    factor = max(0.0, pooled - 2.0) / (pooled + 2.0)
    result, shares = np.zeros_like(x), []
    left = np.concatenate([x, noise], axis=-1)
    for spacing, detail, smooth in details(left, guide, wrap):
        left = smooth
        d, e = detail[..., :channels], detail[..., channels:]
        energy = np.stack([np.square(d).mean(axis=-1), np.square(e).mean(axis=-1)], axis=-1)
        for _ in range(2):
            energy = _smooth(energy, spacing, wrap, None)
        whole, noisy = energy[..., :1], energy[..., 1:]
        share = np.clip(1.0 - factor * noisy / np.where(whole > 0, whole, 1.0), 0.0, 1.0)
        result += share * d
        shares.append(float(share.mean()))
    return result + left[..., :channels], shares


def details(x: np.ndarray, guide: np.ndarray, wrap: Sequence[bool]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """(spacing in texels, the detail at this spacing, what is left) from the finest; x is all details and the last that is left."""
    for level in range(levels_of(x.shape[:-1])):
        spacing = 1 << level
        smooth = _smooth(x, spacing, wrap, guide)
        yield spacing, x - smooth, smooth
        x = smooth


def _smooth(x: np.ndarray, spacing: int, wrap: Sequence[bool], guide: np.ndarray | None) -> np.ndarray:
    """The mean over neighbours at a spacing, as far as they exist, by the taps and, with a guide, by how alike it is there.

    Two texels count by exp(−|a_i − a_j|² / 2 s²) with s² the mean of |a_i − a_j|² over all pairs at the same offset: half of those of
    a guide that is all noise remain neighbours, and an edge that stands out of the rest separates.
    """
    total, weights = np.zeros_like(x), np.zeros((*x.shape[:-1], 1), x.dtype)
    for offset in itertools.product(_TAPS, repeat=x.ndim - 1):
        neighbour, exists = _neighbours(x.shape[:-1], offset, spacing, wrap)
        weight = exists * float(np.prod([_TAPS[o] for o in offset]))
        if guide is not None and any(offset):
            weight = weight * _alike(guide, neighbour(guide), exists)
        total += weight * neighbour(x)
        weights += weight
    return total / weights


def _alike(guide: np.ndarray, other: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """How alike a guide and its neighbour are, (*grid, 1), in (0, 1]; 1 where the guide is constant."""
    square = np.square(guide - other).sum(axis=-1, keepdims=True) * exists
    pairs = exists.sum()
    mean = float(square.sum() / pairs) if pairs else 0.0
    return np.exp(-0.5 * square / mean) if mean > 0 else np.ones_like(square)


def _neighbours(
    grid: tuple[int, ...], offset: tuple[int, ...], spacing: int, wrap: Sequence[bool]
) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """A function from a map to that of the neighbours at an offset, and where there are any, (*grid, 1), as 0 or 1.

    Where an axis has one texel, it has no neighbours there.
    """
    exists = np.ones((*grid, 1), np.float32)
    index = []
    for axis, (size, step, wraps) in enumerate(zip(grid, offset, wrap, strict=True)):
        at = np.arange(size) + step * spacing
        inside = np.ones(size, bool) if wraps and (size > 1 or step == 0) else (at >= 0) & (at < size)
        exists = exists * inside.reshape([-1 if a == axis else 1 for a in range(len(grid) + 1)])
        index.append(at % size)
    place = np.ix_(*index)
    return lambda x: x[place], exists
