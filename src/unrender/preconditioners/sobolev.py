"""Sobolev gradients and large steps: powers of (I + λ L)^-1 on textures, grids and meshes.

Descent along the gradient of the H¹ inner product in place of L²: Neuberger 1997, "Sobolev Gradients and Differential Equations". Large
steps: Nicolet, Jacobson and Jakob 2021, "Large Steps in Inverse Rendering of Geometry".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from unrender.core import arrays, checks, periodic
from unrender.core.arrays import Array
from unrender.core.checks import NotNegative
from unrender.core.registry import register
from unrender.preconditioners import grid
from unrender.preconditioners.base import Around, around_axis
from unrender.preconditioners.mesh import MeshSpectrum, MeshTopology


@register
@dataclass(frozen=True)
class Sobolev:
    """S = (I + λ L)^(-1/2) with the graph Laplacian L of the texture's grid, for each channel separately.

    The loop applies S to gradients and to steps, so a gradient g moves the parameter along (I + λ L)^-1 g, the gradient in the Sobolev
    space H¹. Independent noise is averaged over neighbouring texels, and all detail stays reachable: a pattern that alternates from texel
    to texel on d axes moves 1 + 4 d λ times more slowly than a constant. `LargeSteps` has S = (I + λ L)^-1, and thus the square of this
    factor.

    It suits textures with the statistics of photographs, whose power spectra decrease with frequency f as 1/f²: (I + λ L)^-1 is the
    covariance of such a texture at distances beyond √λ texels.

    Supports textures (H, W, C), grids (Z, Y, X, C) and values at the V vertices of a mesh (n V,). For a mesh, L is that of its edges, and
    S is approximated to a few percent (`MeshSpectrum`). Computed on the host in float32. The result has the argument's type. For Dr.Jit
    arrays it waits for the device, and copies to and from a GPU. S is symmetric with eigenvalues in [(1 + 4 d λ)^(-1/2), 1].

    For more than 131072 texels or cells with borders on all sides, a pyramid on the device approximates S (`GridPyramid`), and the host
    gets the coarsest level only. Errors are a few percent, and a fifth to a third for detail of a few texels.

    Args:
        strength: λ, >= 0; 0 is the identity. None for (`correlation` N)², where N is the geometric mean of the grid's sides, or √V for a
            mesh.
        wrap: whether opposite borders are neighbours, as in a tiling texture: one truth value, or one per axis.
        correlation: √λ relative to N if no strength is given, >= 0.
    """

    strength: NotNegative | None = None
    wrap: bool | tuple[bool, ...] = False
    correlation: NotNegative = 1 / 8
    _spectrum: MeshSpectrum | None = field(default=None, init=False, repr=False, compare=False)
    _columns: int = field(default=0, init=False, repr=False, compare=False)

    def __post_init__(self):
        checks.fields(self)
        object.__setattr__(self, "wrap", grid.wraps("Sobolev", self.wrap))

    def on_mesh(self, topology: MeshTopology) -> Sobolev:
        return replace(self)._bound(MeshSpectrum(topology, self._strength_on(topology)))

    def on_repeated(self, columns: int) -> Sobolev:
        """Return the preconditioner of an environment map. A map of more than 131072 texels keeps borders on all sides."""
        return replace(self)._bound(None, columns)

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        if self._spectrum is not None:
            return
        if (around := self._around(shape)) is not None:
            return around.check(key, shape)
        grid.check("Sobolev", key, shape, self.wrap)

    def apply(self, x: Array) -> Array:
        """Return S x, with the shape and type of `x`. Raises `InputError` for an unsupported shape."""
        if (spectrum := self._spectrum) is not None:
            values = spectrum.topology.split("Sobolev", arrays.numpy(x))
            return arrays.like(spectrum.root(self._strength_on(spectrum.topology), values).reshape(-1), x)
        shape = arrays.shape(x)
        self.check("parameter", shape)
        if (around := self._around(shape)) is not None:
            return around.apply(x)
        return self._solved(x, 0.5)

    def apply_twice(self, x: Array) -> Array:
        """Return S² x."""
        if self._spectrum is not None or self._around(arrays.shape(x)) is not None:
            return self.apply(self.apply(x))
        return self._solved(x, 1.0)

    def _solved(self, x: Array, power: float) -> Array:
        """Return (I + λ L)^-power x of a texture or grid."""
        shape = arrays.shape(x)
        if (pyramid := self._pyramid(shape)) is not None:
            return pyramid.apply(x, self.strength_of(shape), power)
        solver = grid.solver(self.strength_of(shape), shape[:-1], self._wraps(shape), power)
        return arrays.like(solver.solve(arrays.numpy(x)), x)

    def strength_of(self, shape: tuple[int, ...]) -> float:
        """Return λ for a texture or grid of this shape, or for the mesh if there is one."""
        if self._spectrum is not None:
            return self._strength_on(self._spectrum.topology)
        cells = periodic.interior_shape(shape, self._columns)[:-1]
        if self.strength is not None:
            return float(self.strength)
        return (self.correlation * math.prod(cells) ** (1 / len(cells))) ** 2

    def scaled(self, share: float) -> Sobolev:
        """Return the preconditioner with λ times `share`, >= 0."""
        if self.strength is None:
            scaled = replace(self, correlation=self.correlation * math.sqrt(share))
        else:
            scaled = replace(self, strength=self.strength * share)
        return scaled._bound(self._spectrum, self._columns)

    def descents(self, smooth: Array, gradient: Array, shares: np.ndarray) -> np.ndarray:
        """Return S_s g · S_s g' and |S_s g|² for two estimates g and g' of a gradient, where S_s = (I + s λ L)^(-1/2).

        Args:
            smooth: S g.
            gradient: g'.
            shares: s, (n,), >= 0.

        Returns:
            (2, n), float64: sums over all elements.
        """
        if (spectrum := self._spectrum) is not None:
            first, second = (spectrum.topology.split("Sobolev", arrays.numpy(x)) for x in (smooth, gradient))
            return spectrum.descents(self._strength_on(spectrum.topology), first, second, shares)
        shape = arrays.shape(gradient)
        if (around := self._around(shape)) is not None:
            first, second = (periodic.interior(arrays.numpy(x), self._columns) for x in (smooth, gradient))
            return around.inner.descents(first, second, shares)
        transform = grid.transform(shape[:-1], self._wraps(shape))
        strength, eigenvalues = self.strength_of(shape), transform.eigenvalues
        first = transform.forward(arrays.numpy(smooth)) * np.sqrt(1.0 + strength * eigenvalues)
        second = transform.forward(arrays.numpy(gradient))
        sums = [np.real(first * np.conj(second)).sum(axis=-1), np.square(np.abs(first)).sum(axis=-1)]
        gains = [1.0 / (1.0 + share * strength * eigenvalues[..., 0]) for share in shares]
        return np.array([[np.vdot(gain, part) for gain in gains] for part in sums])

    def summary(self, gradient: Array) -> np.ndarray | None:
        """Return the part of a gradient that `descents_of_summaries` needs, (m,) float32; None for meshes and small grids (`descents`)."""
        pyramid = self._pyramid(arrays.shape(gradient))
        return None if pyramid is None else pyramid.summary(gradient)

    def descents_of_summaries(
        self, shape: tuple[int, ...], first: np.ndarray, second: np.ndarray, shares: np.ndarray
    ) -> np.ndarray:
        """Estimate the result of `descents` from the summaries of g and g', gradients of this shape. Requires `is_on_device(shape)`."""
        pyramid = self._pyramid(shape)
        assert pyramid is not None
        strengths = self.strength_of(shape) * np.asarray(shares)
        return np.stack([pyramid.products(first, other, strengths) for other in (second, first)])

    def is_on_device(self, shape: tuple[int, ...]) -> bool:
        """Return whether an array of this shape stays on the device, as large textures and grids do."""
        return self._pyramid(shape) is not None

    def _pyramid(self, shape: tuple[int, ...]) -> grid.GridPyramid | None:
        """Return the pyramid that replaces transforms of a large grid; None for small grids and meshes."""
        if self._spectrum is not None or self._around(shape) is not None:
            return None
        if math.prod(shape[:-1]) <= grid.LARGEST_EXACT or any(self._wraps(shape)):
            return None
        return grid.pyramid(shape[:-1])

    def _around(self, shape: tuple[int, ...]) -> Around[Sobolev] | None:
        """Return the preconditioner of an environment map that is small enough for transforms; None for anything else."""
        if not self._columns or math.prod(shape[:2]) > grid.LARGEST_EXACT:
            return None
        return Around(replace(self, wrap=around_axis(self.wrap)), self._columns)

    def _bound(self, spectrum: MeshSpectrum | None, columns: int = 0) -> Sobolev:
        object.__setattr__(self, "_spectrum", spectrum)
        object.__setattr__(self, "_columns", columns)
        return self

    def _strength_on(self, mesh: MeshTopology) -> float:
        vertices = len(mesh.places)
        return float(self.strength) if self.strength is not None else self.correlation**2 * vertices

    def _wraps(self, shape: tuple[int, ...]) -> tuple[bool, ...]:
        return grid.per_axis(self.wrap, len(shape) - 1)


@register
@dataclass(frozen=True)
class LargeSteps:
    """S = (I + λ L)^-1 with the graph Laplacian L of the texture's grid or of the mesh, for each channel or coordinate separately.

    S blurs gradient noise and steps over about √λ texels (its kernel falls by e over √λ). Constants are preserved, and S has full rank,
    so the minima are the same and all detail is reachable. S is symmetric with eigenvalues in [1/(1 + 4 d λ), 1] on d axes.

    Supports textures (H, W, C), grids (Z, Y, X, C), and values at mesh vertices (n V,). For vertex positions use `Adam(uniform=True)` as
    in the paper: one step scale for all vertices keeps smooth steps smooth. Mesh vertices at the same position move together. Computed on
    the host in float32. The result has the argument's type. For Dr.Jit arrays it waits for the device, and copies to and from a GPU.

    Args:
        strength: λ, >= 0; 0 is the identity. Usual values are 1 to 100.
        wrap: whether opposite borders are neighbours, as in a tiling texture: one truth value, or one per axis. An environment map (H, W,
            C) wraps as (False, True).
    """

    strength: NotNegative = 10.0
    wrap: bool | tuple[bool, ...] = False
    _mesh: MeshTopology | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        checks.fields(self)
        object.__setattr__(self, "wrap", grid.wraps("LargeSteps", self.wrap))

    def on_mesh(self, topology: MeshTopology) -> LargeSteps:
        bound = LargeSteps(self.strength, self.wrap)
        object.__setattr__(bound, "_mesh", topology)
        return bound

    def on_repeated(self, columns: int) -> Around:
        """Return the preconditioner of an environment map."""
        return Around(replace(self, wrap=around_axis(self.wrap)), columns)

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        if self._mesh is not None:
            return
        grid.check("LargeSteps", key, shape, self.wrap)

    def apply(self, x: Array) -> Array:
        """Return S x, with the shape and type of `x`. Raises `InputError` for an unsupported shape."""
        if self._mesh is not None:
            return arrays.like(self._mesh.solver(float(self.strength)).solve(arrays.numpy(x)), x)
        shape = arrays.shape(x)
        self.check("parameter", shape)
        solver = grid.solver(float(self.strength), shape[:-1], grid.per_axis(self.wrap, len(shape) - 1))
        return arrays.like(solver.solve(arrays.numpy(x)), x)
