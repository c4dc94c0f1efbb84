"""What a preconditioner is."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from unrender.core.arrays import Array
from unrender.preconditioners.mesh import MeshTopology

__all__ = ["MeshPreconditioner", "PeriodicPreconditioner", "Preconditioner"]


class Preconditioner(Protocol):
    """A symmetric positive linear map S of one parameter's gradients and steps.

    The loop hands S g to the optimizer and adds S (step): descent in the coordinates u where the parameter is x = S u.
    """

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        """Raise `InputError` where this map does not suit a parameter of that shape."""
        ...

    def apply(self, x: Array) -> Array:
        """S x, of the shape and kind of `x`."""
        ...


@runtime_checkable
class MeshPreconditioner(Protocol):
    """A preconditioner that suits values at the vertices of a mesh, such as positions, once it knows the mesh."""

    def on_mesh(self, topology: MeshTopology) -> Preconditioner:
        """The same for values at the V vertices of a mesh, (n V,)."""
        ...


@runtime_checkable
class PeriodicPreconditioner(Protocol):
    """A preconditioner that suits an array whose outer columns repeat those of the opposite end, such as an environment map."""

    def on_repeated(self, columns: int) -> Preconditioner:
        """Return the same for (H, W + 2 `columns`, C): neighbours go on across the left and right borders."""
        ...
