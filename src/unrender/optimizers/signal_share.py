"""How far successive gradients agree, cell by cell."""

from __future__ import annotations

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.preconditioners.base import Preconditioner

__all__ = ["signal_share"]

_LEAST_SIGNAL = 0.02
"""The least factor of a step: gradients that were noise may come to tell something."""


def signal_share(
    smooth: Preconditioner, product: Array, square: Array, unknown: float, confirmed: float, vertices: int
) -> np.ndarray:
    """The share of signal per element, in [0.02, 1], float32 of the shape of `product`, as in Wiener's filter.

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
    return np.broadcast_to(share, parts[0].shape).astype(np.float32).reshape(shape)
