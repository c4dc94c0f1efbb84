"""Steps of textures and grids at all scales at once: those of the coefficients of a Laplacian pyramid.

Burt and Adelson 1983, "The Laplacian Pyramid as a Compact Image Code"; as a preconditioner of inverse rendering Weier et al. 2025,
"Practical Inverse Rendering of Textured and Translucent Appearance"; sums over levels as preconditioners are those of Bramble, Pasciak and
Xu 1990, "Parallel Multilevel Preconditioners".
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
"""Below it, nothing but the coarsest level moves."""


@register
@dataclass(frozen=True)
class LaplacianPyramid:
    """S = Σ_l a_l U_l D_l^-1 U_lᵀ over the levels l of a pyramid, with Σ a_l = 1, each channel by itself.

    A texture that is the sum Σ_l U_l p_l of a pyramid of levels p_l, each half as fine as the one before and interpolated linearly by U_l
    to the texture's resolution, moves along Σ_l U_l U_lᵀ g when the levels descend in place of texels: all that a coarse texel covers moves
    together, while level 0, U_0 = I, leaves all detail within reach. D_l, the diagonal matrix of the sums U_lᵀ 1, makes of U_lᵀ g a mean
    over what the coarse texel covers, so that constants pass unchanged whatever the shares a_l. S is symmetric, its eigenvalues lie in
    [a_0, 1].

    Adam stands between gradient and step here, as with the other preconditioners: it normalises per texel what all levels together make
    of a gradient. Weier et al. have it normalise the coefficients of each level apart, which no map from texels to texels can.

    With a `falloff` of r the shares a_l grow as 1/r^l: what varies over 2^l texels moves as if by shares of up to l. At 1/2, S
    falls in proportion to the frequency, as `Sobolev` does where λ is large; at 1, of equal shares, only with its logarithm.

    Suits textures (H, W, C) and grids (Z, Y, X, C), of any sides: an odd side is halved upwards. The result is computed on the host in
    float32, in time proportional to the number of texels, and has the argument's type; on Dr.Jit it waits for the device, and copies to
    and fro where that is a GPU.

    Args:
        levels: of the pyramid, the texture itself among them, >= 1; 1 does nothing. None for all, down to a single texel. More than these
            are as all.
        falloff: r, a level's share over that of the next coarser one, in [0.001, 1].
        wrap: whether opposite borders are neighbours, as for a tiling texture; for all axes, or one truth value per
            axis: an environment map (H, W, C) wraps as (False, True).
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
        """See `Preconditioner.apply`. Raises `InputError` for a shape that does not suit."""
        shape = arrays.shape(x)
        self.check("parameter", shape)
        wrap = grid.per_axis(self.wrap, len(shape) - 1)
        axes = [_pyramid(size, wraps, self.levels) for size, wraps in zip(shape[:-1], wrap, strict=True)]
        return arrays.like(_sum_over_levels(arrays.numpy(x), axes, self.falloff), x)


@dataclass(frozen=True)
class _Level:
    """A level of the pyramid along one axis.

    Attributes:
        interpolation: from this level to the next finer one, (n, m) for sides n and m; None of the texture itself.
        sums: of the interpolation to the texture, over its texels, (m,).
    """

    interpolation: scipy.sparse.csr_matrix | None
    sums: np.ndarray


@lru_cache(maxsize=64)
def _pyramid(size: int, wraps: bool, levels: int | None) -> tuple[_Level, ...]:
    """The levels along an axis of `size` texels, from the finest to, at most, that of a single texel."""
    made = [_Level(None, np.ones(size, np.float32))]
    to_texture = None
    while len(made[-1].sums) > 1 and (levels is None or len(made) < levels):
        step = _interpolation(len(made[-1].sums), wraps)
        to_texture = step if to_texture is None else to_texture @ step
        made.append(_Level(step, np.asarray(to_texture.sum(axis=0), np.float32).ravel()))
    return tuple(made)


def _interpolation(size: int, wraps: bool) -> scipy.sparse.csr_matrix:
    """Linear interpolation between the centres of ⌈n/2⌉ texels, at those of n: (n, ⌈n/2⌉), of rows that sum to 1."""
    import scipy.sparse

    coarse = (size + 1) // 2
    at = (np.arange(size) + 0.5) * (coarse / size) - 0.5
    before = np.floor(at).astype(int)
    share = at - before
    ends = [end % coarse if wraps else np.clip(end, 0, coarse - 1) for end in (before, before + 1)]
    entries = np.concatenate([1.0 - share, share]), (np.tile(np.arange(size), 2), np.concatenate(ends))
    return scipy.sparse.csr_matrix(entries, (size, coarse), np.float32)


def _sum_over_levels(x: np.ndarray, axes: Sequence[tuple[_Level, ...]], falloff: float) -> np.ndarray:
    """S x for the pyramids of each axis; a shorter axis stays at its single texel while the others go on."""
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
    """D_l, (*coarse grid, 1): the product of what the axes' texels cover."""
    covered = np.ones((1,) * (len(axes) + 1), np.float32)
    for axis, levels in enumerate(axes):
        sums = levels[min(level, len(levels) - 1)].sums
        covered = covered * sums.reshape([-1 if a == axis else 1 for a in range(len(axes) + 1)])
    return covered


def _along(x: np.ndarray, axes: Sequence[tuple[_Level, ...]], level: int, transposed: bool) -> np.ndarray:
    """U from this level to the next finer one along each axis that has it; `transposed`, Uᵀ from there."""
    for axis, levels in enumerate(axes):
        step = levels[level].interpolation if level < len(levels) else None
        if step is None:
            continue
        matrix = step.T if transposed else step
        moved = np.moveaxis(x, axis, 0)
        product = matrix @ moved.reshape(moved.shape[0], -1)
        x = np.moveaxis(product.reshape(-1, *moved.shape[1:]), 0, axis)
    return np.ascontiguousarray(x)
