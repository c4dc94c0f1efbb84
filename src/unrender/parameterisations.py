"""Changes of variables for the optimizer, so that one learning rate suits reflectances, radiances and extinctions alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.registry import register

__all__ = ["Identity", "Log", "Parameterisation"]

Bounds = tuple[float | None, float | None]
"""(low, high); None is unbounded."""


class Transform(Protocol):
    """A smooth increasing elementwise map x = φ(u) from the optimizer's variable u to the values x of a parameter.

    Arrays are NumPy's or Dr.Jit's, and results have the argument's type. Every x is inside the bounds less a margin, where φ' > 0.
    """

    def forward(self, u: Array) -> Array:
        """Return φ(u)."""
        ...

    def inverse(self, x: Array) -> Array:
        """Return the u with φ(u) = x."""
        ...

    def slope(self, x: Array) -> Array:
        """Return φ' > 0 at the u with φ(u) = x."""
        ...

    def curvature(self, x: Array) -> Array:
        """Return φ'' at the u with φ(u) = x."""
        ...


@runtime_checkable
class Parameterisation(Protocol):
    """A rule that defines the optimizer's variable from a parameter's bounds and initial values."""

    def transform(self, bounds: Bounds, initial: np.ndarray) -> Transform | None:
        """Return φ of a parameter with these bounds and initial values; None for the identity.

        Raises `InputError` for unsuitable bounds.
        """
        ...


_LARGEST = 80.0  # magnitude at which u is clamped in exponentials: e^88 is the limit of single precision


@register(position=0)
@dataclass(frozen=True)
class Identity:
    """u = x: steps have the parameter's unit."""

    def transform(self, bounds: Bounds, initial: np.ndarray) -> Transform | None:
        del bounds, initial


@register(position=1)
@dataclass(frozen=True)
class Log:
    """u = log(x − low): a step η multiplies the distance from the lower bound by e^η, a relative change of about η.

    Use it for positive values of unknown order of magnitude: the radiance of an emitter, the extinction of a medium. Steps are invariant
    to the unit: scaling every value and the rest of the problem by c scales the optimisation by c. Values near the bound change slowly.
    φ' is 0 at the bound, so the loop keeps a margin (`scene.bounds`). An upper bound is enforced by projection.
    """

    def transform(self, bounds: Bounds, initial: np.ndarray) -> Transform:
        return _Log(_lower(bounds))


@dataclass(frozen=True)
class _Log:
    low: float

    def forward(self, u: Array) -> Array:
        return arrays.exp(arrays.clip(u, -_LARGEST, _LARGEST)) + self.low

    def inverse(self, x: Array) -> Array:
        return arrays.log(x - self.low)

    def slope(self, x: Array) -> Array:
        return x - self.low

    def curvature(self, x: Array) -> Array:
        return x - self.low


def _lower(bounds: Bounds) -> float:
    low, high = bounds
    if low is None:
        shown = "open" if high is None else f"{high:g}"
        raise InputError(f"log needs a lower bound, got bounds open to {shown}; give bounds, such as [0, inf]")
    return low
