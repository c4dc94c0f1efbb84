"""Preconditioner of textures and grids by a Laplacian pyramid, which takes steps at all scales.

Burt and Adelson 1983, "The Laplacian Pyramid as a Compact Image Code". Weier et al. 2025, "Practical Inverse Rendering of Textured and
Translucent Appearance", use it in inverse rendering. Bramble, Pasciak and Xu 1990, "Parallel Multilevel Preconditioners", introduce sums
over levels as preconditioners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import scipy.sparse

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.preconditioners import grid
from unrender.preconditioners.base import Around, around_axis

_LEAST_FALLOFF = 0.001
"""Smallest falloff: below it, almost only the coarsest level receives steps."""


@register
@dataclass(frozen=True)
class LaplacianPyramid:
    """S = Σ_l a_l U_l D_l^-1 U_lᵀ over the levels l of a pyramid, with Σ a_l = 1, for each channel separately.

    Consider a texture Σ_l U_l p_l with levels p_l of halved resolution, interpolated linearly by U_l to the texture's resolution.
    Gradient descent on the levels changes the texture along Σ_l U_l U_lᵀ g. All texels under a coarse texel then change together, and
    level 0, U_0 = I, keeps all detail reachable. D_l is the diagonal matrix of the sums U_lᵀ 1. It turns U_lᵀ g into a mean, so that
    constants are preserved for all shares a_l. S is symmetric with eigenvalues in [a_0, 1].

    Adam normalises the sum of all levels per texel, as with the other preconditioners. Weier et al. normalise the coefficients of each
    level separately, which a map from texels to texels cannot do.

    With `falloff` r the shares a_l grow as 1/r^l: structure of 2^l texels is scaled by the shares up to level l. At r = 1/2, S decreases
    in proportion to the frequency, as `Sobolev` does for large λ. At r = 1, with equal shares, it decreases with the logarithm of the
    frequency.

    Supports textures (H, W, C) and grids (Z, Y, X, C) with any sides; odd sides are halved and rounded up. Computed on the host in
    float32, in time proportional to the number of texels. The result has the argument's type. For Dr.Jit arrays it waits for the device,
    and copies to and from a GPU.

    Args:
        levels: number of levels including the texture, >= 1; 1 is the identity. None, or a larger number than exist, takes all levels
            down to a single texel.
        falloff: r, ratio of a level's share to that of the next coarser one, in [0.001, 1].
        wrap: whether opposite borders are neighbours, as in a tiling texture: one truth value, or one per axis. An environment map (H, W,
            C) wraps as (False, True).
    """

    levels: int | None = None
    falloff: float = 0.5
    wrap: bool | tuple[bool, ...] = False

    def __post_init__(self):
        if self.levels is not None:
            checks.integer("LaplacianPyramid", "levels", self.levels, at_least=1)
        if not _LEAST_FALLOFF <= checks.number("LaplacianPyramid", "falloff", self.falloff, above=0.0) <= 1:
            raise InputError(f"LaplacianPyramid: falloff must be from {_LEAST_FALLOFF} to 1, got {self.falloff!r}")
        object.__setattr__(self, "wrap", grid.wraps("LaplacianPyramid", self.wrap))

    def on_repeated(self, columns: int) -> Around:
        """Return the preconditioner of an environment map."""
        return Around(replace(self, wrap=around_axis(self.wrap)), columns)

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        grid.check("LaplacianPyramid", key, shape, self.wrap)

    def apply(self, x: Array) -> Array:
        """Return S x, with the shape and type of `x`. Raises `InputError` for an unsupported shape."""
        shape = arrays.shape(x)
        self.check("parameter", shape)
        wrap = grid.per_axis(self.wrap, len(shape) - 1)
        axes = [_pyramid(size, wraps, self.levels) for size, wraps in zip(shape[:-1], wrap, strict=True)]
        return arrays.like(_sum_over_levels(arrays.numpy(x), axes, self.falloff), x)


@dataclass(frozen=True)
class _Level:
    """A level of the pyramid along one axis.

    Attributes:
        interpolation: matrix from this level to the next finer one, (n, m) for sides n and m; None for the texture.
        sums: column sums of the interpolation to the texture, (m,).
    """

    interpolation: scipy.sparse.csr_matrix | None
    sums: np.ndarray


@lru_cache(maxsize=64)
def _pyramid(size: int, wraps: bool, levels: int | None) -> tuple[_Level, ...]:
    """Return the levels along an axis of `size` texels, from the finest down to at most a single texel."""
    made = [_Level(None, np.ones(size, np.float32))]
    to_texture = None
    while len(made[-1].sums) > 1 and (levels is None or len(made) < levels):
        step = _interpolation(len(made[-1].sums), wraps)
        to_texture = step if to_texture is None else to_texture @ step
        made.append(_Level(step, np.asarray(to_texture.sum(axis=0), np.float32).ravel()))
    return tuple(made)


def _interpolation(size: int, wraps: bool) -> scipy.sparse.csr_matrix:
    """Return the linear interpolation from ⌈n/2⌉ to n texel centres, (n, ⌈n/2⌉); rows sum to 1."""
    import scipy.sparse

    coarse = (size + 1) // 2
    at = (np.arange(size) + 0.5) * (coarse / size) - 0.5
    before = np.floor(at).astype(int)
    share = at - before
    ends = [end % coarse if wraps else np.clip(end, 0, coarse - 1) for end in (before, before + 1)]
    entries = np.concatenate([1.0 - share, share]), (np.tile(np.arange(size), 2), np.concatenate(ends))
    return scipy.sparse.csr_matrix(entries, (size, coarse), np.float32)


def _sum_over_levels(x: np.ndarray, axes: Sequence[tuple[_Level, ...]], falloff: float) -> np.ndarray:
    """Return S x for the pyramids of each axis. A shorter axis stays at a single texel on further levels."""
    count = max(len(levels) for levels in axes)
    shares = falloff ** -np.arange(count, dtype=np.float64)
    shares /= shares.sum()
    restricted = [np.asarray(x, np.float32)]
    for level in range(1, count):
        restricted.append(_along(restricted[-1], axes, level, transposed=True))
    result = np.zeros_like(restricted[-1])
    for level in range(count - 1, -1, -1):
        result = result + restricted[level] * (np.float32(shares[level]) / _covered(axes, level))
        if level:
            result = _along(result, axes, level, transposed=False)
    return result


def _covered(axes: Sequence[tuple[_Level, ...]], level: int) -> np.ndarray:
    """Return the diagonal of D_l, (*coarse grid, 1): the product of the axes' sums."""
    covered = np.ones((1,) * (len(axes) + 1), np.float32)
    for axis, levels in enumerate(axes):
        sums = levels[min(level, len(levels) - 1)].sums
        covered = covered * sums.reshape([-1 if a == axis else 1 for a in range(len(axes) + 1)])
    return covered


def _along(x: np.ndarray, axes: Sequence[tuple[_Level, ...]], level: int, transposed: bool) -> np.ndarray:
    """Apply U from this level to the next finer one along each axis that has it; with `transposed`, Uᵀ from there."""
    for axis, levels in enumerate(axes):
        step = levels[level].interpolation if level < len(levels) else None
        if step is None:
            continue
        matrix = step.T if transposed else step
        moved = np.moveaxis(x, axis, 0)
        product = matrix @ moved.reshape(moved.shape[0], -1)
        x = np.moveaxis(product.reshape(-1, *moved.shape[1:]), 0, axis)
    return np.ascontiguousarray(x)
