"""Sobolev gradients of textures and grids.

Descent along the gradient of the H¹ inner product in place of that of L²: Neuberger 1997, "Sobolev Gradients and Differential Equations".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.registry import register
from unrender.preconditioners import grid

__all__ = ["Sobolev"]

_CORRELATION = 1 / 8
"""Of the mean side of a texture: √λ where no strength is given."""


@register
@dataclass(frozen=True)
class Sobolev:
    """S = (I + λ L)^(-1/2) with the graph Laplacian L of the texture's grid, each channel by itself.

    The loop applies S to gradients and to steps, so a gradient g moves the parameter along (I + λ L)^-1 g, the gradient in the Sobolev
    space H¹. Independent noise in texels is averaged with that of their neighbours, while detail stays within reach: a pattern that
    alternates from texel to texel on d axes moves 1 + 4 d λ times more slowly than a constant one. `LargeSteps` has S = (I + λ L)^-1,
    and the square of that factor.

    Among linear preconditioners it is the natural one for textures like those of photographs, whose spectra fall with the frequency f
    as 1/f² in power: (I + λ L)^-1 is the covariance of such a texture beyond √λ texels.

    Suits textures (H, W, C) and grids (Z, Y, X, C). The result is computed on the host in float32 and has the argument's type; on Dr.Jit
    it waits for the device, and copies to and fro where that is a GPU. S is symmetric, its eigenvalues lie in [(1 + 4 d λ)^(-1/2), 1].

    Args:
        strength: λ, >= 0; 0 does nothing. None for (N/8)², N the geometric mean of the grid's sides.
        wrap: whether opposite borders are neighbours, as for a tiling texture; for all axes, or one truth value per axis.
    """

    strength: float | None = None
    wrap: bool | tuple[bool, ...] = False

    def __post_init__(self):
        if self.strength is not None:
            checks.number("Sobolev", "strength", self.strength, above=0.0, inclusive=True)
        object.__setattr__(self, "wrap", grid.wraps("Sobolev", self.wrap))

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        """See `Preconditioner.check`."""
        grid.check("Sobolev", key, shape, self.wrap)

    def apply(self, x: Array) -> Array:
        """See `Preconditioner.apply`. Raises `InputError` for a shape that does not suit."""
        shape = arrays.shape(x)
        self.check("parameter", shape)
        cells = shape[:-1]
        strength = self.strength
        if strength is None:
            strength = (_CORRELATION * math.prod(cells) ** (1 / len(cells))) ** 2
        solver = grid.square_root_solver(float(strength), cells, grid.per_axis(self.wrap, len(cells)))
        return arrays.like(solver.solve(arrays.numpy(x)), x)
