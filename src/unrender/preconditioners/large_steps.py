"""Smooth steps on textures, grids and meshes.

After Nicolet, Jacobson and Jakob 2021, "Large Steps in Inverse Rendering of Geometry".
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
    """S = (I + λ L)^-1 with the graph Laplacian L of the texture's grid, or of the mesh, each channel or coordinate by itself.

    Gradient noise and steps are blurred over about √λ texels (the kernel of S falls by e over √λ), while constants
    pass unchanged and no detail is out of reach: S has full rank, so the descent has the same minima. S is symmetric,
    its eigenvalues lie in [1/(1 + 4 d λ), 1] on d axes.

    Suits textures (H, W, C), grids (Z, Y, X, C), values at the vertices of meshes (n V,) and their positions, which go with
    `Adam(uniform=True)` as in the paper: one rate for all vertices keeps smooth steps smooth. Vertices of a mesh at the same place move as
    one. The result is computed on the host in float32 and has the argument's type; on Dr.Jit it waits for the device, and copies to and fro
    where that is a GPU.

    Args:
        strength: λ, >= 0; 0 does nothing. 1 to 100 is usual.
        wrap: whether opposite borders are neighbours, as for a tiling texture; for all axes, or one truth value per
            axis: an environment map (H, W, C) wraps as (False, True).
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
        """See `Preconditioner.apply`. Raises `InputError` for a shape that does not suit."""
        if self._mesh is not None:
            return arrays.like(self._mesh.solver(float(self.strength)).solve(arrays.numpy(x)), x)
        shape = arrays.shape(x)
        self.check("parameter", shape)
        solver = grid.solver(float(self.strength), shape[:-1], grid.per_axis(self.wrap, len(shape) - 1))
        return arrays.like(solver.solve(arrays.numpy(x)), x)
