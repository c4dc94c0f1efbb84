"""Solvers of (I + λ L) y = x on a grid, L its graph Laplacian, and powers of its inverse.

(L x)_i is the sum of x_i − x_j over the neighbours j of cell i, one before and one after along each axis. At the
border there is no neighbour (zero slope), or with `wrap` the cell at the other end.

Two solvers of the same system. In two dimensions the sparse Cholesky factor is small. In three its fill-in grows like
n^(4/3): 48³ cells take half a minute and 64³ several, so there the Laplacian is diagonalised instead, by the cosine
transform along axes with a border and the Fourier transform along axes that wrap.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    import scipy.sparse

from unrender.core.errors import InputError


class Solver(Protocol):
    """(I + λ L)^-1 on one grid."""

    def solve(self, x: np.ndarray) -> np.ndarray:
        """y with (I + λ L) y = x, each channel by itself. x, y: (*grid, channels), float32."""
        ...


class CholeskySolver:
    """By sparse Cholesky factorisation, once; a solve costs the factor's entries."""

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
    """The orthonormal transform in which L is diagonal: of cosines along axes with a border, Fourier's along axes that wrap.

    Attributes:
        eigenvalues: of L, (*grid, 1).
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
        """The spectrum of x, (*grid, channels), float32; complex where axes wrap."""
        import scipy.fft

        y = np.asarray(x, np.float32)
        if self._bordered:
            y = np.asarray(scipy.fft.dctn(y, axes=self._bordered, norm="ortho"))
        return np.asarray(scipy.fft.fftn(y, axes=self._wrapped, norm="ortho")) if self._wrapped else y

    def backward(self, spectrum: np.ndarray) -> np.ndarray:
        """The array that has this spectrum, float32."""
        import scipy.fft

        y = spectrum
        if self._wrapped:
            y = np.real(np.asarray(scipy.fft.ifftn(y, axes=self._wrapped, norm="ortho")))
        if self._bordered:
            y = np.asarray(scipy.fft.idctn(y, axes=self._bordered, norm="ortho"))
        return np.ascontiguousarray(y, np.float32)


class TransformSolver:
    """By the transform in which L is diagonal: n log n, nothing to factorise. Solves (I + λ L)^power y = x."""

    def __init__(self, strength: float, grid: tuple[int, ...], wrap: tuple[bool, ...], power: float = 1.0):
        self._transform = transform(grid, wrap)
        self._gain = ((1.0 + strength * self._transform.eigenvalues) ** -power).astype(np.float32)

    def solve(self, x: np.ndarray) -> np.ndarray:
        return self._transform.backward(self._transform.forward(x) * self._gain)


@lru_cache(maxsize=16)
def transform(grid: tuple[int, ...], wrap: tuple[bool, ...]) -> Transform:
    """The transform of one grid, made once; `wrap` says per axis whether its two ends are neighbours."""
    return Transform(grid, wrap)


@lru_cache(maxsize=16)
def solver(strength: float, grid: tuple[int, ...], wrap: tuple[bool, ...]) -> Solver:
    """The solver of one system, made once.

    Args:
        strength: λ, >= 0.
        grid: number of cells per axis.
        wrap: per axis, whether its two ends are neighbours.
    """
    return (CholeskySolver if len(grid) <= 2 else TransformSolver)(strength, grid, wrap)


@lru_cache(maxsize=16)
def square_root_solver(strength: float, grid: tuple[int, ...], wrap: tuple[bool, ...]) -> Solver:
    """The solver of (I + λ L)^(1/2) y = x; arguments as for `solver`."""
    return TransformSolver(strength, grid, wrap, 0.5)


def check(owner: str, key: str, shape: tuple[int, ...], wrap: bool | tuple[bool, ...]) -> None:
    """Raise `InputError` unless `shape` is a texture's or a grid's of more than one texel, and `wrap` has as many axes."""
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
    """Whether a shape is that of a texture (H, W, C) or a grid (Z, Y, X, C) with neighbours to average with."""
    return len(shape) in (3, 4) and shape[-1] > 0 and min(shape[:-1], default=0) > 0 and max(shape[:-1]) > 2


def wraps(owner: str, wrap: Any) -> bool | tuple[bool, ...]:
    """What a preconditioner was given for `wrap`, a list of a problem file as a tuple. Raises `InputError` for anything else."""
    found = tuple(wrap) if isinstance(wrap, list) else wrap  # TOML gives lists, which have no hash
    axes = found if isinstance(found, tuple) else (found,)
    if not axes or not all(isinstance(wraps, bool) for wraps in axes):
        raise InputError(f"{owner}: wrap must be true, false, or one of these per axis, got {found!r}")
    return found


def per_axis(wrap: bool | tuple[bool, ...], axes: int) -> tuple[bool, ...]:
    """`wrap` as one truth value per axis."""
    return wrap if isinstance(wrap, tuple) else (wrap,) * axes


def laplacian(grid: tuple[int, ...], wrap: tuple[bool, ...]) -> scipy.sparse.csr_matrix:
    """L as a sparse matrix over the cells in row-major order: symmetric, positive semi-definite, rows sum to 0."""
    import scipy.sparse

    cells = int(np.prod(grid))
    index = np.arange(cells).reshape(grid)
    starts, ends = [], []
    for axis, (size, wraps) in enumerate(zip(grid, wrap, strict=True)):
        after = np.roll(index, -1, axis)
        kept = range(size if wraps else size - 1)
        starts.append(np.take(index, kept, axis).ravel())
        ends.append(np.take(after, kept, axis).ravel())
    i, j = np.concatenate(starts), np.concatenate(ends)
    edges = scipy.sparse.coo_matrix((np.ones(len(i)), (i, j)), (cells, cells))
    adjacency = edges + edges.T
    return (scipy.sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency).tocsr()
