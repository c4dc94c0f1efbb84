"""Changes of variables for the optimizer, so that one learning rate suits reflectances, radiances and extinctions alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.core.text import in_words, reason_of

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


def check_transform(transform: Transform, x: np.ndarray) -> None:
    """Raise `InputError` unless inverse, slope and curvature belong to `forward` at values x: else steps and standard errors would be wrong
    by factors that nothing shows."""
    x, h = np.asarray(x, np.float64), 1e-3
    try:
        u, slope = transform.inverse(x), transform.slope(x)
        below, here, above = (np.asarray(transform.forward(u + offset)) for offset in (-h, 0.0, h))
        differences = {"inverse": here - x, "slope": (above - below) / (2 * h) - slope}
        if hasattr(transform, "curvature"):
            slopes = np.asarray(transform.slope(above)) - np.asarray(transform.slope(below))
            differences["curvature"] = slopes / (2 * h) - transform.curvature(x)
        wrong = [name for name, each in differences.items() if not np.median(np.abs(each) - 0.01 * slope) <= 0]
    except Exception as error:  # of any function of the user's
        raise InputError(f"its transform, {in_words(transform)}, fails: {reason_of(error, 300)}") from error
    if wrong:
        raise InputError(f"{type(transform).__name__}.{wrong[0]} does not belong to its forward, or forward decreases")
