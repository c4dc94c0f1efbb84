"""Preconditioners of arrays whose outer columns repeat those of the opposite end, such as environment maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from unrender.core import arrays, periodic
from unrender.core.arrays import Array
from unrender.preconditioners.base import Preconditioner

__all__ = ["Around", "around_axis"]

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
