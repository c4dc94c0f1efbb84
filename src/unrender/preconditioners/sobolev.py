"""Sobolev gradients of textures and grids.

Descent along the gradient of the H¹ inner product in place of that of L²: Neuberger 1997, "Sobolev Gradients and Differential Equations".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.registry import register
from unrender.preconditioners import grid

__all__ = ["Sobolev"]


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
        strength: λ, >= 0; 0 does nothing. None for (`correlation` N)², N the geometric mean of the grid's sides.
        wrap: whether opposite borders are neighbours, as for a tiling texture; for all axes, or one truth value per axis.
        correlation: √λ where no strength is given, as a share of N, >= 0.
    """

    strength: float | None = None
    wrap: bool | tuple[bool, ...] = False
    correlation: float = 1 / 8

    def __post_init__(self):
        if self.strength is not None:
            checks.number("Sobolev", "strength", self.strength, above=0.0, inclusive=True)
        checks.number("Sobolev", "correlation", self.correlation, above=0.0, inclusive=True)
        object.__setattr__(self, "wrap", grid.wraps("Sobolev", self.wrap))

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        """See `Preconditioner.check`."""
        grid.check("Sobolev", key, shape, self.wrap)

    def apply(self, x: Array) -> Array:
        """See `Preconditioner.apply`. Raises `InputError` for a shape that does not suit."""
        shape = arrays.shape(x)
        self.check("parameter", shape)
        solver = grid.square_root_solver(self.strength_of(shape), shape[:-1], self._wraps(shape))
        return arrays.like(solver.solve(arrays.numpy(x)), x)

    def strength_of(self, shape: tuple[int, ...]) -> float:
        """λ for a texture or grid of this shape."""
        cells = shape[:-1]
        if self.strength is not None:
            return float(self.strength)
        return (self.correlation * math.prod(cells) ** (1 / len(cells))) ** 2

    def scaled(self, share: float) -> Sobolev:
        """The same with `share` of λ, >= 0."""
        if self.strength is None:
            return replace(self, correlation=self.correlation * math.sqrt(share))
        return replace(self, strength=self.strength * share)

    def descents(self, smooth: Array, gradient: Array, shares: np.ndarray) -> np.ndarray:
        """With `shares` s of λ and S_s = (I + s λ L)^(-1/2), of two estimates g and g' of a gradient: S_s g · S_s g' and |S_s g|².

        Args:
            smooth: S g.
            gradient: g'.
            shares: s, (n,), >= 0.

        Returns:
            (2, n), float64: sums over all elements.
        """
        shape = arrays.shape(gradient)
        transform = grid.transform(shape[:-1], self._wraps(shape))
        strength, eigenvalues = self.strength_of(shape), transform.eigenvalues
        first = transform.forward(arrays.numpy(smooth)) * np.sqrt(1.0 + strength * eigenvalues)
        second = transform.forward(arrays.numpy(gradient))
        sums = [np.real(first * np.conj(second)).sum(axis=-1), np.square(np.abs(first)).sum(axis=-1)]
        gains = [1.0 / (1.0 + share * strength * eigenvalues[..., 0]) for share in shares]
        return np.array([[np.vdot(gain, part) for gain in gains] for part in sums])

    def _wraps(self, shape: tuple[int, ...]) -> tuple[bool, ...]:
        return grid.per_axis(self.wrap, len(shape) - 1)
