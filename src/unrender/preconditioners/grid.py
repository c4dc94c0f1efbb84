"""Solvers of (I + λ L) y = x on a grid with graph Laplacian L, and of powers of its inverse.

(L x)_i is the sum of x_i − x_j over the neighbours j of cell i, one on each side along each axis. Beyond a border there is no neighbour
(zero slope), or with `wrap` the cell at the other end.

The cosine transform diagonalises L along axes with borders, and the Fourier transform along axes that wrap.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from unrender.core.errors import InputError


class Transform:
    """The orthonormal transform that diagonalises L: cosine transform along axes with borders, Fourier transform along axes that wrap.

    Attributes:
        eigenvalues: eigenvalues of L, (*grid, 1).
    """

    def __init__(self, grid: tuple[int, ...], wrap: tuple[bool, ...]):
        self._bordered = [axis for axis, wraps in enumerate(wrap) if not wraps]
        self._wrapped = [axis for axis, wraps in enumerate(wrap) if wraps]
        self.eigenvalues = np.zeros((*grid, 1))
        for axis, (size, wraps) in enumerate(zip(grid, wrap, strict=True)):
            turn = (2.0 if wraps else 1.0) * np.pi / size
            along = 2.0 - 2.0 * np.cos(turn * np.arange(size))
            self.eigenvalues += along.reshape([-1 if a == axis else 1 for a in range(len(grid) + 1)])

    def forward(self, x: np.ndarray) -> np.ndarray:
        """Return the spectrum of x, (*grid, channels), float32; complex if an axis wraps."""
        import scipy.fft

        y = np.asarray(x, np.float32)
        if self._bordered:
            y = np.asarray(scipy.fft.dctn(y, axes=self._bordered, norm="ortho"))
        return np.asarray(scipy.fft.fftn(y, axes=self._wrapped, norm="ortho")) if self._wrapped else y

    def backward(self, spectrum: np.ndarray) -> np.ndarray:
        """Return the array with this spectrum, float32."""
        import scipy.fft

        y = spectrum
        if self._wrapped:
            y = np.real(np.asarray(scipy.fft.ifftn(y, axes=self._wrapped, norm="ortho")))
        if self._bordered:
            y = np.asarray(scipy.fft.idctn(y, axes=self._bordered, norm="ortho"))
        return np.ascontiguousarray(y, np.float32)


class TransformSolver:
    """Solver of (I + λ L)^power y = x by the diagonalising transform, in O(n log n) without factorisation.

    The fill-in of a sparse Cholesky factor would grow as n^(4/3) on grids of voxels.
    """

    def __init__(self, strength: float, grid: tuple[int, ...], wrap: tuple[bool, ...], power: float):
        self._transform = transform(grid, wrap)
        self._gain = ((1.0 + strength * self._transform.eigenvalues) ** -power).astype(np.float32)

    def solve(self, x: np.ndarray) -> np.ndarray:
        """Return y for x, for each channel separately. x, y: (*grid, channels), float32."""
        return self._transform.backward(self._transform.forward(x) * self._gain)


@lru_cache(maxsize=16)
def transform(grid: tuple[int, ...], wrap: tuple[bool, ...]) -> Transform:
    """Return the cached transform of a grid; `wrap` states per axis whether its two ends are neighbours."""
    return Transform(grid, wrap)


@lru_cache(maxsize=16)
def solver(strength: float, grid: tuple[int, ...], wrap: tuple[bool, ...], power: float = 1.0) -> TransformSolver:
    """Return the cached solver of (I + λ L)^power y = x.

    Args:
        strength: λ, >= 0.
        grid: number of cells per axis.
        wrap: per axis, whether its two ends are neighbours.
        power: exponent, > 0.
    """
    return TransformSolver(strength, grid, wrap, power)


def check(owner: str, key: str, shape: tuple[int, ...], wrap: bool | tuple[bool, ...]) -> None:
    """Raise `InputError` unless `shape` is a texture or grid of more than one texel and `wrap` has as many axes."""
    if len(shape) not in (3, 4) or int(np.prod(shape[:-1])) < 2 or shape[-1] < 1:
        raise InputError(
            f"{key}: preconditioner {owner} needs a texture (H, W, C) or a grid (Z, Y, X, C) of more than one "
            f"texel, got shape {tuple(shape)}"
        )
    if isinstance(wrap, tuple) and len(wrap) != len(shape) - 1:
        raise InputError(
            f"{key}: preconditioner {owner}: wrap must have {len(shape) - 1} entries for shape {tuple(shape)}, "
            f"got {len(wrap)}"
        )


def is_map(shape: tuple[int, ...]) -> bool:
    """Return whether a shape is a texture (H, W, C) or grid (Z, Y, X, C) with more than two texels along some axis."""
    return len(shape) in (3, 4) and shape[-1] > 0 and min(shape[:-1], default=0) > 0 and max(shape[:-1]) > 2


def wraps(owner: str, wrap: Any) -> bool | tuple[bool, ...]:
    """Return the setting `wrap` with a list converted to a tuple. Raises `InputError` for anything else than booleans."""
    setting = tuple(wrap) if isinstance(wrap, list) else wrap  # TOML has lists, which are not hashable
    axes = setting if isinstance(setting, tuple) else (setting,)
    if not axes or not all(isinstance(wraps, bool) for wraps in axes):
        raise InputError(f"{owner}: wrap must be true, false, or one of these per axis, got {setting!r}")
    return setting


def per_axis(wrap: bool | tuple[bool, ...], axes: int) -> tuple[bool, ...]:
    """Return `wrap` as one truth value per axis."""
    return wrap if isinstance(wrap, tuple) else (wrap,) * axes
