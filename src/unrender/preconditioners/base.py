"""What a preconditioner is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, runtime_checkable

from unrender.core import arrays, periodic
from unrender.core.arrays import Array
from unrender.preconditioners.mesh import MeshTopology


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


_Inner = TypeVar("_Inner", bound=Preconditioner)


@dataclass(frozen=True)
class Around(Generic[_Inner]):
    """A preconditioner applied to the columns that are unknown; the others are copies of the result.

    The map is symmetric and positive on these columns, as `inner` is. Computed on the host, of the argument's type.

    Args:
        inner: suits (H, W, C), with neighbours across the left and right borders.
        columns: number of repeated columns at each end of (H, W + 2 `columns`, C).
    """

    inner: _Inner
    columns: int

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        """Raise `InputError` where `inner` does not suit the unknown columns."""
        self.inner.check(key, periodic.interior_shape(shape, self.columns))

    def apply(self, x: Array) -> Array:
        """Return S x, of the shape and kind of `x`."""
        found = self.inner.apply(periodic.interior(arrays.numpy(x), self.columns))
        return arrays.like(periodic.pad(found, self.columns), x)


def around_axis(wrap: bool | tuple[bool, ...]) -> tuple[bool, ...]:
    """Return which of the two axes of an environment map (H, W, C) wrap, given what the preconditioner was asked for."""
    return (wrap[0] if isinstance(wrap, tuple) else False, True)
