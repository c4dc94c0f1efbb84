"""What a parameterisation is."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from unrender.core.arrays import Array

Bounds = tuple[float | None, float | None]
"""(low, high); None is open."""


class Transform(Protocol):
    """A smooth increasing map x = φ(u) from the variable u that an optimizer moves to the values x of a parameter, element by element.

    Arrays are NumPy's or Dr.Jit's, results of the argument's type. Every x is inside the bounds, less a margin, where φ' > 0.
    """

    def forward(self, u: Array) -> Array:
        """φ(u)."""
        ...

    def inverse(self, x: Array) -> Array:
        """The u with φ(u) = x."""
        ...

    def slope(self, x: Array) -> Array:
        """φ' at the u with φ(u) = x, > 0."""
        ...

    def curvature(self, x: Array) -> Array:
        """φ'' there."""
        ...


class Parameterisation(Protocol):
    """A rule by which a parameter becomes the variable that an optimizer moves."""

    def transform(self, bounds: Bounds, initial: np.ndarray) -> Transform | None:
        """φ of a parameter with these bounds and initial values; None where φ(u) = u.

        Raises `InputError` for bounds that do not suit.
        """
        ...
