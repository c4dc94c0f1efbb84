"""Preconditioner of large steps on textures, grids and meshes.

Follows Nicolet, Jacobson and Jakob 2021, "Large Steps in Inverse Rendering of Geometry".
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.registry import register
from unrender.preconditioners import grid
from unrender.preconditioners.base import Around, around_axis
from unrender.preconditioners.mesh import MeshTopology


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

    strength: float = 10.0
    wrap: bool | tuple[bool, ...] = False
    _mesh: MeshTopology | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self):
        checks.number("LargeSteps", "strength", self.strength, above=0.0, inclusive=True)
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
