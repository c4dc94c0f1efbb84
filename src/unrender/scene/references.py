"""Values and loss weights of single pixels of the references of all views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.io.stored_pictures import StoredPicture
from unrender.scene.view import View

ON_DEVICE = 1 << 29
"""Maximum size in bytes of references that are copied to the device; larger sets stay in host memory."""


class References:
    """Values and loss weights of single pixels of the references.

    Small sets are copied to the renderer's device once. From large sets only the requested pixels are copied, from host memory or from
    the file of a `StoredPicture`.

    Args:
        views: views with references (H, W, 3) and masks (H, W) or None.
        array: function that makes arrays of the renderer.
        on_device: maximum size in bytes of references that are copied to the device.
    """

    def __init__(self, views: Sequence[View], array: Callable[[np.ndarray], Array], on_device: int = ON_DEVICE):
        self._views = views
        self._array = array
        self._sizes = [_size(view.reference) for view in views]
        self._factors = [view.weight / size for view, size in zip(views, self._sizes, strict=True)]
        self.in_host_memory = 4 * sum(self._sizes) > on_device

    @cached_property
    def sensors(self) -> Array:
        """Sensor index of each view, integers."""
        return arrays.like_integers(np.array([view.sensor for view in self._views]), self._array(np.zeros(1)))

    def at(self, views: Array, pixels: Array) -> tuple[Array, Array]:
        """Return the reference values (N, 3) of these pixels, and the factors of their losses (N, 1): weight * mask / (H * W * 3).

        Args:
            views: index of each pixel's view, (N,).
            pixels: row-major index in its film, (N,).
        """
        if self.in_host_memory:
            return self._from_host(arrays.numpy(views), arrays.numpy(pixels))
        row = self.rows(views, pixels)
        factors = arrays.gather_rows(self._view_factors, views)
        if self._all_masks is not None:
            factors = factors * arrays.gather_rows(self._all_masks, row)
        return arrays.gather_rows(self._all_references, row), factors

    def rows(self, views: Array, pixels: Array) -> Array:
        """Return the index of these pixels in the concatenation of all views, (N,)."""
        return arrays.gather(self._starts, views) + pixels

    def _from_host(self, views: np.ndarray, pixels: np.ndarray) -> tuple[Array, Array]:
        values = np.empty((len(pixels), 3), np.float32)
        factors = np.empty((len(pixels), 1), np.float32)
        for view in np.unique(views):
            here = views == view
            own = self._views[view]
            values[here] = _rows(own.reference, pixels[here], 3)
            factors[here] = self._factors[view] * (1.0 if own.mask is None else _rows(own.mask, pixels[here], 1))
        return self._array(values), self._array(factors)

    @cached_property
    def _all_references(self) -> Array:
        return self._array(np.concatenate([np.asarray(view.reference).reshape(-1, 3) for view in self._views]))

    @cached_property
    def _all_masks(self) -> Array | None:
        if all(view.mask is None for view in self._views):
            return None
        pairs = zip(self._views, self._sizes, strict=True)
        columns = [np.ones(size // 3) if view.mask is None else np.asarray(view.mask).ravel() for view, size in pairs]
        return self._array(np.concatenate(columns)[:, None])

    @cached_property
    def _starts(self) -> Any:
        sizes = [size // 3 for size in self._sizes]
        return arrays.like_integers(np.cumsum([0, *sizes[:-1]]), self._array(np.zeros(1)))

    @cached_property
    def _view_factors(self) -> Array:
        return self._array(np.array(self._factors)[:, None])


def _size(picture: Any) -> int:
    """Return the number of values. A stored image is not read."""
    return picture.size if isinstance(picture, StoredPicture) else np.asarray(picture).size


def _rows(picture: Any, pixels: np.ndarray, channels: int) -> np.ndarray:
    """Return the values of these pixels, (N, C)."""
    if isinstance(picture, StoredPicture):
        return picture.rows(pixels)
    return np.asarray(picture).reshape(-1, channels)[pixels]
