"""Solvers of (I + λ L) y = x on a grid with graph Laplacian L, and of powers of its inverse.

(L x)_i is the sum of x_i − x_j over the neighbours j of cell i, one on each side along each axis. Beyond a border there is no neighbour
(zero slope), or with `wrap` the cell at the other end.

Two solvers are used. In two dimensions the sparse Cholesky factor is small. In three dimensions its fill-in grows as n^(4/3): 48³ cells
take half a minute and 64³ several. There the Laplacian is diagonalised by the cosine transform along axes with borders, and by the
Fourier transform along axes that wrap.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    import scipy.sparse

from unrender.core.errors import InputError


class Solver(Protocol):
    """Solver of (I + λ L) y = x on one grid."""

    def solve(self, x: np.ndarray) -> np.ndarray:
        """Return y with (I + λ L) y = x, for each channel separately. x, y: (*grid, channels), float32."""
        ...


class CholeskySolver:
    """Solver by a sparse Cholesky factorisation that is computed once. A solve takes time proportional to the factor's entries."""

    def __init__(self, strength: float, grid: tuple[int, ...], wrap: tuple[bool, ...]):
        import scipy.sparse
        from cholespy import CholeskySolverF, MatrixType  # type: ignore  (a compiled module without stubs)

        cells = int(np.prod(grid))
        matrix = (scipy.sparse.identity(cells) + strength * laplacian(grid, wrap)).tocoo()
        rows, columns = matrix.row.astype(np.int32), matrix.col.astype(np.int32)
        entries = matrix.data.astype(np.float64)
        self._factor = CholeskySolverF(cells, rows, columns, entries, MatrixType.COO)

    def solve(self, x: np.ndarray) -> np.ndarray:
        right = np.ascontiguousarray(x, np.float32).reshape(-1, x.shape[-1])
        result = np.empty_like(right)
        self._factor.solve(right, result)
        return result.reshape(x.shape)


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
    """Solver of (I + λ L)^power y = x by the diagonalising transform, in O(n log n) without factorisation."""

    def __init__(self, strength: float, grid: tuple[int, ...], wrap: tuple[bool, ...], power: float = 1.0):
        self._transform = transform(grid, wrap)
        self._gain = ((1.0 + strength * self._transform.eigenvalues) ** -power).astype(np.float32)

    def solve(self, x: np.ndarray) -> np.ndarray:
        return self._transform.backward(self._transform.forward(x) * self._gain)


@lru_cache(maxsize=16)
def transform(grid: tuple[int, ...], wrap: tuple[bool, ...]) -> Transform:
    """Return the cached transform of a grid; `wrap` states per axis whether its two ends are neighbours."""
    return Transform(grid, wrap)


@lru_cache(maxsize=16)
def solver(strength: float, grid: tuple[int, ...], wrap: tuple[bool, ...]) -> Solver:
    """Return the cached solver of one system.

    Args:
        strength: λ, >= 0.
        grid: number of cells per axis.
        wrap: per axis, whether its two ends are neighbours.
    """
    return (CholeskySolver if len(grid) <= 2 else TransformSolver)(strength, grid, wrap)


@lru_cache(maxsize=16)
def square_root_solver(strength: float, grid: tuple[int, ...], wrap: tuple[bool, ...]) -> Solver:
    """Return the cached solver of (I + λ L)^(1/2) y = x; arguments as in `solver`."""
    return TransformSolver(strength, grid, wrap, 0.5)


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


def laplacian(grid: tuple[int, ...], wrap: tuple[bool, ...]) -> scipy.sparse.csr_matrix:
    """Return L as a sparse matrix over the cells in row-major order: symmetric, positive semi-definite, with zero row sums."""
    import scipy.sparse

    cells = int(np.prod(grid))
    index = np.arange(cells).reshape(grid)
    starts, ends = [], []
    for axis, (size, wraps) in enumerate(zip(grid, wrap, strict=True)):
        after = np.roll(index, -1, axis)
        starting = range(size if wraps else size - 1)
        starts.append(np.take(index, starting, axis).ravel())
        ends.append(np.take(after, starting, axis).ravel())
    i, j = np.concatenate(starts), np.concatenate(ends)
    edges = scipy.sparse.coo_matrix((np.ones(len(i)), (i, j)), (cells, cells))
    adjacency = edges + edges.T
    return (scipy.sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency).tocsr()
