"""Solvers of (I + λ L) y = x on a grid with graph Laplacian L, and of powers of its inverse.

(L x)_i is the sum of x_i − x_j over the neighbours j of cell i, one on each side along each axis. Beyond a border there is no neighbour
(zero slope), or with `wrap` the cell at the other end.

The cosine transform diagonalises L along axes with borders, and the Fourier transform along axes that wrap. `GridPyramid` approximates
powers on large grids, on the device, in time proportional to the number of cells: a sum over the levels of a pyramid (Bramble, Pasciak
and Xu 1990, "Parallel Multilevel Preconditioners").
"""

from __future__ import annotations

import itertools
import math
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.text import in_words


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
    """Return the cached solver of (I + λ L)^power y = x on a grid of cells, whose ends are neighbours along axes that `wrap`; λ >= 0, power
    > 0."""
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
        raise InputError(f"{owner}: wrap must be true, false, or one of these per axis, got {in_words(setting)}")
    return setting


def per_axis(wrap: bool | tuple[bool, ...], axes: int) -> tuple[bool, ...]:
    """Return `wrap` as one truth value per axis."""
    return wrap if isinstance(wrap, tuple) else (wrap,) * axes


LARGEST_EXACT = 1 << 17
"""Number of cells up to which transforms of the full grid are used in place of a pyramid."""
_COARSEST = 1 << 16
"""Maximum number of cells of the coarsest level, and of the samples of each finer level in `GridPyramid.summary`."""
_PER_OCTAVE, _FINER = 8, 3
"""Frequencies per octave and direction at which weights are fitted, and octaves below the coarsest level that the fit includes."""
_CORRECTED = 0.3  # gain of the interpolation at which the coarsest level corrects the error of the sum by half
_SMALLEST = 1e-12  # smallest gain that is divided by


class GridPyramid:
    """Approximation S = c_0 I + P (c_1 I + P (c_2 I + ... P M R ...) R) R of (I + λ L)^-p on a grid with borders, per channel.

    R halves every side, rounded up, with weights (1, 3, 3, 1) / 8 along each axis. P interpolates linearly between the centres of cells.
    P is the adjoint of R up to a factor, except at the last cells of odd sides. P R multiplies a wave of frequency f by cos(f/2)^6 along
    each axis. The weights c >= 0 are fitted by non-negative least squares of relative errors. At p = 1/2, S is between 0.8 and 1.4 times
    the exact map for detail of a few cells, and within a few percent for coarser structure. There M, diagonal in the cosine transform of
    the coarsest level, corrects the error of the sum. Constants are preserved.

    Args:
        cells: sides of the grid, two or three.

    Attributes:
        levels: sides of each level, from the finest to the first with at most 65536 cells.
    """

    def __init__(self, cells: tuple[int, ...]):
        self.levels = [tuple(cells)]
        while math.prod(self.levels[-1]) > _COARSEST:
            self.levels.append(tuple((side + 1) // 2 for side in self.levels[-1]))
        self._weights = lru_cache(maxsize=64)(self._fitted)

    def apply(self, x: Array, strength: float, power: float) -> Array:
        """Return S x, with the shape (*cells, channels) and type of x, evaluated. Waits for the device."""
        shape = arrays.shape(x)
        weights, gain = self._weights(strength, power)
        parts = self._restricted(x)
        coarsest = (*self.levels[-1], shape[-1])
        cosines = transform(coarsest[:-1], (False,) * (len(shape) - 1))
        spectrum = cosines.forward(arrays.numpy(parts[-1]).reshape(coarsest))
        y = arrays.like(cosines.backward(spectrum * gain).reshape(-1), parts[-1])
        for level in reversed(range(len(self.levels) - 1)):
            fine, coarse = self.levels[level], self.levels[level + 1]
            y = _interpolated(y, coarse, fine, shape[-1]) + arrays.scalar(float(weights[level]), y) * parts[level]
            arrays.evaluate(y)
        return arrays.shaped(y, shape, x)

    def summary(self, x: Array) -> np.ndarray:
        """Return the part of x that `products` needs, (n,) float32: the coarsest level, and of each finer level one cell per block.

        The sampled cells are the same for all x. Waits for the device.
        """
        parts, channels = self._restricted(x), arrays.shape(x)[-1]
        samples = [
            arrays.numpy(_rows(part, cells, channels)) for part, cells in zip(parts, self._samples, strict=False)
        ]
        return np.concatenate([*samples, arrays.numpy(parts[-1])]).astype(np.float32)

    def products(self, first: np.ndarray, second: np.ndarray, strengths: np.ndarray) -> np.ndarray:
        """Estimate x · (I + λ L)^-1 y for each λ of `strengths`, (n,) float64, from the summaries of x and y."""
        axes, coarsest = len(self.levels[0]), math.prod(self.levels[-1])
        counts = [len(cells) for cells in self._samples]
        channels = len(first) // (sum(counts) + coarsest)
        cells_per_coarse, ends = math.prod(self.levels[0]) / coarsest, channels * np.cumsum(counts)
        *fine, last = np.split(first.astype(np.float64) * second, ends)
        detail = np.array([cells_per_coarse * part.sum() for part in fine])
        cosines = transform(self.levels[-1], (False,) * axes)
        one, other = (
            cosines.forward(x[len(x) - last.size :].reshape(*self.levels[-1], channels)) for x in (first, second)
        )
        spectrum = cells_per_coarse * (one.astype(np.float64) * other).sum(axis=-1, keepdims=True)
        products = []
        for strength in strengths:
            weights, gain = self._weights(float(np.float32(strength)), 1.0)
            products.append((weights * detail).sum() + (gain * spectrum).sum())
        return np.array(products)

    @cached_property
    def _samples(self) -> list[np.ndarray]:
        """Return one cell of each block that a cell of the coarsest level covers, for each level but the coarsest."""
        rng = np.random.default_rng(0)
        samples = []
        for level, cells in enumerate(self.levels[:-1]):
            side = 1 << (len(self.levels) - 1 - level)
            index = np.zeros(self.levels[-1], np.int64)
            for axis, size in enumerate(cells):
                block = np.arange(self.levels[-1][axis]).reshape([-1 if a == axis else 1 for a in range(len(cells))])
                at = np.minimum(side * block + rng.integers(side, size=index.shape), size - 1)
                index = index * size + at
            samples.append(index.reshape(-1))
        return samples

    def _restricted(self, x: Array) -> list[Array]:
        """Return R^l x of each level l, (cells · channels,) each."""
        parts, channels = [arrays.flat(x)], arrays.shape(x)[-1]
        arrays.evaluate(parts[0])
        for fine, coarse in itertools.pairwise(self.levels):
            parts.append(_halved(parts[-1], fine, coarse, channels))
            arrays.evaluate(parts[-1])
        return parts

    def _fitted(self, strength: float, power: float) -> tuple[np.ndarray, np.ndarray]:
        """Return c of all levels but the coarsest, and the diagonal of M, (*cells, 1) float32."""
        from scipy.optimize import nnls

        eigenvalues, gains = self._fitted_waves
        weights, _ = nnls(gains.T * ((1.0 + strength * eigenvalues) ** power)[:, None], np.ones(len(eigenvalues)))
        eigenvalues, gains = self._coarse_waves
        finer = len(self.levels) - 1
        weights[:finer] /= max(1.0, weights[:finer].sum())
        interpolation, response = gains[finer], np.tensordot(weights, gains, 1)
        tail = np.tensordot(weights[finer:], gains[finer:], 1) / np.maximum(interpolation, _SMALLEST)
        missing = (1.0 + strength * eigenvalues) ** -power - response
        mended = tail + missing * interpolation / (interpolation**2 + _CORRECTED**2)
        mended[(0,) * mended.ndim] = 1.0 - weights[:finer].sum()
        return weights[:finer], np.maximum(mended, 0.0)[..., None].astype(np.float32)

    @cached_property
    def _fitted_waves(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues of L, (n,), and gains of P^l R^l, (levels, n), of the waves at which weights are fitted."""
        octaves = np.arange(0, len(self.levels) + _FINER, 1 / _PER_OCTAVE)
        directions = [d for d in itertools.product((0.0, 0.5, 1.0), repeat=len(self.levels[0])) if max(d) == 1.0]
        waves = np.pi * (2.0 ** -octaves[:, None, None] * np.array(directions)).reshape(-1, len(self.levels[0]))
        return _eigenvalues(waves), _gains(waves, len(self.levels) + _FINER)

    @cached_property
    def _coarse_waves(self) -> tuple[np.ndarray, np.ndarray]:
        """The same for the waves of the coarsest level's transform: (*cells,) and (levels, *cells)."""
        sides = [np.pi / side * np.arange(side) for side in self.levels[-1]]
        waves = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1) * 0.5 ** (len(self.levels) - 1)
        return _eigenvalues(waves), _gains(waves, len(self.levels) + _FINER)


def _eigenvalues(waves: np.ndarray) -> np.ndarray:
    return (2.0 - 2.0 * np.cos(waves)).sum(axis=-1)


def _gains(waves: np.ndarray, count: int) -> np.ndarray:
    """Return the gains of P^l R^l for waves of frequencies (..., axes), for l = 0, ..., count - 1: (count, ...)."""
    gains = [np.ones(waves.shape[:-1])]
    for level in range(count - 1):
        gains.append(gains[-1] * np.prod(np.cos(2.0 ** (level - 1) * waves) ** 6, axis=-1))
    return np.stack(gains)


def _coordinates(index: Array, sides: tuple[int, ...]) -> list[Array]:
    """Return the coordinates along each axis of elements in row-major order."""
    coordinates = []
    for side in reversed(sides):
        quotient = index // side
        coordinates.append(index - quotient * side)
        index = quotient
    return coordinates[::-1]


def _strides(cells: tuple[int, ...], channels: int) -> list[int]:
    return [channels * math.prod(cells[axis + 1 :]) for axis in range(len(cells))]


def _weighted(x: Array, offset: Array, taps: list[list[tuple[Array, float]]]) -> Array:
    """Return Σ w x[offset + o] over the products of the axes' taps (o, w)."""
    if not taps:
        return arrays.gather(x, offset)
    along, *rest = taps
    parts = [_weighted(x, offset + step, rest) * weight for step, weight in along]
    while len(parts) > 1:
        parts = [one + other for one, other in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]


def _halved(x: Array, fine: tuple[int, ...], coarse: tuple[int, ...], channels: int) -> Array:
    """Return R x; border cells are repeated beyond the border."""
    *at, channel = _coordinates(arrays.arange(x, math.prod(coarse) * channels), (*coarse, channels))
    taps = []
    for cell, side, stride in zip(at, fine, _strides(fine, channels), strict=True):
        middle = cell * 2
        before = arrays.where(cell > 0, middle - 1, middle)
        after = [arrays.minimum(middle + step, side - 1) for step in (1, 2)]
        steps = (before, middle, *after)
        taps.append([(step * stride, weight) for step, weight in zip(steps, (0.125, 0.375, 0.375, 0.125), strict=True)])
    return _weighted(x, channel, taps)


def _interpolated(y: Array, coarse: tuple[int, ...], fine: tuple[int, ...], channels: int) -> Array:
    """Return P y; border cells are repeated beyond the border."""
    *at, channel = _coordinates(arrays.arange(y, math.prod(fine) * channels), (*fine, channels))
    taps = []
    for cell, side, stride in zip(at, coarse, _strides(coarse, channels), strict=True):
        nearest = cell // 2
        before = arrays.where(nearest > 0, nearest - 1, nearest)
        other = arrays.where(cell > nearest * 2, arrays.minimum(nearest + 1, side - 1), before)
        taps.append([(nearest * stride, 0.75), (other * stride, 0.25)])
    return _weighted(y, channel, taps)


def _rows(x: Array, cells: np.ndarray, channels: int) -> Array:
    index = (cells[:, None] * channels + np.arange(channels)).reshape(-1)
    return arrays.gather(x, arrays.like_integers(index, x))


@lru_cache(maxsize=16)
def pyramid(cells: tuple[int, ...]) -> GridPyramid:
    """Return the cached pyramid of a grid."""
    return GridPyramid(cells)
