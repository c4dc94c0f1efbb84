"""Protocols of preconditioners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from unrender.core import arrays, periodic
from unrender.core.arrays import Array
from unrender.preconditioners.mesh import MeshTopology


@runtime_checkable
class Preconditioner(Protocol):
    """A symmetric positive definite linear map S of one parameter's gradients and steps.

    The loop passes S g to the optimizer and adds S (step) to the parameter. This is an optimisation in coordinates v with x = S v.
    """

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        """Raise `InputError` if this map does not support a parameter of this shape."""
        ...

    def apply(self, x: Array) -> Array:
        """Return S x, with the shape and type of `x`."""
        ...


@runtime_checkable
class MeshPreconditioner(Protocol):
    """A preconditioner that supports values at mesh vertices, such as positions, once it is bound to the mesh."""

    def on_mesh(self, topology: MeshTopology) -> Preconditioner:
        """Return the preconditioner for n values at each of the V vertices of a mesh, (n V,)."""
        ...


@runtime_checkable
class PeriodicPreconditioner(Protocol):
    """A preconditioner that supports arrays with repeated border columns, such as environment maps."""

    def on_repeated(self, columns: int) -> Preconditioner:
        """Return the preconditioner for (H, W + 2 `columns`, C), where the left and right borders are neighbours."""
        ...


@dataclass(frozen=True)
class HeldElements:
    """A preconditioner among the elements that may move, and 0 for those that stay at a bound.

    It does not spread the gradient of elements that cannot move over their neighbours.

    Attributes:
        free: 0 for elements that stay, 1 for the others.
    """

    inner: Preconditioner
    free: Array

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        self.inner.check(key, shape)

    def apply(self, x: Array) -> Array:
        free = arrays.numpy(self.free) if isinstance(x, np.ndarray) else self.free
        return free * self.inner.apply(free * x)

    def unchanged(self, before: Array | None) -> Array:
        """Return the part of each element of S x that is as with other elements held: 1 where none of its neighbours are others."""
        moved = self.free - 1.0 if before is None else self.free - before
        changed = moved * moved
        return arrays.where(changed > 0.0, 0.0 * changed, arrays.maximum(1.0 - self.inner.apply(changed), 0.0))


def bound_to(preconditioner: Any, topology: MeshTopology | None, columns: int) -> Any:
    """Return a preconditioner for values at the vertices of a mesh, or with repeated border columns; itself for other parameters."""
    if isinstance(preconditioner, MeshPreconditioner) and topology is not None:
        return preconditioner.on_mesh(topology)
    if isinstance(preconditioner, PeriodicPreconditioner) and columns:
        return preconditioner.on_repeated(columns)
    return preconditioner


_Inner = TypeVar("_Inner", bound=Preconditioner)


@dataclass(frozen=True)
class Around(Generic[_Inner]):
    """A preconditioner of the interior columns. The repeated border columns are copies of the result.

    The map is symmetric and positive definite on the interior columns, as `inner` is. Computed on the host; the result has the argument's
    type.

    Args:
        inner: preconditioner of (H, W, C) that wraps across the left and right borders.
        columns: number of repeated columns at each end of (H, W + 2 `columns`, C).
    """

    inner: _Inner
    columns: int

    def check(self, key: str, shape: tuple[int, ...]) -> None:
        self.inner.check(key, periodic.interior_shape(shape, self.columns))

    def apply(self, x: Array) -> Array:
        result = self.inner.apply(periodic.interior(arrays.numpy(x), self.columns))
        return arrays.like(periodic.pad(result, self.columns), x)


def around_axis(wrap: bool | tuple[bool, ...]) -> tuple[bool, ...]:
    """Return whether each of the two axes of an environment map (H, W, C) wraps; `wrap` is the preconditioner's setting."""
    return (wrap[0] if isinstance(wrap, tuple) else False, True)
