"""How far successive gradients agree, cell by cell."""

from __future__ import annotations

import math

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.preconditioners import Sobolev
from unrender.preconditioners.base import Preconditioner

__all__ = ["signal_share"]

_LEAST_SIGNAL = 0.02
"""The least factor of a step: gradients that were noise may come to tell something."""


def signal_share(
    smooth: Preconditioner, product: Array, square: Array, unknown: float, confirmed: float, vertices: int
) -> Array:
    """The share of signal per element, in [0.02, 1], of the shape and kind of `product`, as in Wiener's filter.

    max(s, 0.02), s = S² ⟨g_t g_{t-1}⟩ / S² ⟨(g_t² + g_{t-1}²) / 2⟩, with means over the channels of a cell: two gradients share the signal,
    not the noise.

    Args:
        smooth: S, which averages over neighbours.
        product, square: the sums over steps that the means ⟨·⟩ are of.
        unknown: the part of the answer that is 1, since little is known yet, in [0, 1].
        confirmed: the share of the products that is no noise remembered.
        vertices: of the mesh whose values these are, (n V,); 0 of textures and grids.
    """
    shape = arrays.shape(product)
    if not vertices and isinstance(smooth, Sobolev) and smooth.is_on_device(shape):
        return _on_device(smooth, product, square, unknown, confirmed)
    cells = (vertices, -1) if vertices else shape
    parts = [arrays.numpy(x).astype(np.float64).reshape(cells) for x in (product, square)]
    means = np.stack([part.mean(axis=-1) for part in parts], axis=-1)
    flat = means.reshape(-1) if vertices else means
    for _ in range(2):
        flat = np.asarray(smooth.apply(flat))
    means = flat.reshape(means.shape)
    whole, squares = means[..., :1] * confirmed, means[..., 1:]
    share = np.where(squares > 0, whole / np.where(squares > 0, squares, 1.0), 1.0)
    share = np.clip((1.0 - unknown) * np.clip(share, 0.0, 1.0) + unknown, _LEAST_SIGNAL, 1.0)
    found = np.broadcast_to(share, parts[0].shape).astype(np.float32).reshape(shape)
    return arrays.like(found, product)


def _on_device(smooth: Sobolev, product: Array, square: Array, unknown: float, confirmed: float) -> Array:
    """The same of textures and grids so large that they stay where they are; lazy on Dr.Jit."""
    *cells, channels = arrays.shape(product)
    kind = arrays.flat(product)
    element = arrays.arange(kind, math.prod(cells) * channels)
    cell = element // channels
    whole, squares = (
        arrays.gather(arrays.flat(smooth.apply_twice(_summed(x, (*cells, 1)))), cell) for x in (product, square)
    )
    whole = whole * arrays.scalar(confirmed, kind)
    known = squares > 0
    share = arrays.where(known, whole / arrays.where(known, squares, 1.0), 1.0)
    part = arrays.scalar(unknown, kind)
    share = arrays.clip((1.0 - part) * arrays.clip(share, 0.0, 1.0) + part, _LEAST_SIGNAL, 1.0)
    return arrays.shaped(share, (*cells, channels), product)


def _summed(x: Array, shape: tuple[int, ...]) -> Array:
    """The sum over channels, of the shape (*cells, 1)."""
    channels, flat = arrays.shape(x)[-1], arrays.flat(x)
    first = arrays.arange(flat, math.prod(shape)) * channels
    found = arrays.gather(flat, first)
    for channel in range(1, channels):
        found = found + arrays.gather(flat, first + channel)
    return arrays.shaped(found, shape, x)
