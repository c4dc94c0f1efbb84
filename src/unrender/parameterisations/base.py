"""Protocols of parameterisations and their maps."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from unrender.core.arrays import Array

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


class Parameterisation(Protocol):
    """A rule that defines the optimizer's variable from a parameter's bounds and initial values."""

    def transform(self, bounds: Bounds, initial: np.ndarray) -> Transform | None:
        """Return φ of a parameter with these bounds and initial values; None for the identity.

        Raises `InputError` for unsuitable bounds.
        """
        ...
