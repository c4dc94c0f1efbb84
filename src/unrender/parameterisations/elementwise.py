"""Identity, logarithm, logit and softplus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.registry import register
from unrender.parameterisations.base import Bounds, Transform

_LARGEST = 80.0
"""Magnitude at which u is clamped in exponentials: e^88 is the limit of single precision."""
_SERIES = 0.1
"""x/s below which log(e^(x/s) − 1) is computed by a series; its relative error there is 3e-8."""

_SMALL = 0.01
"""e^-|u| below which log(1 + e^-|u|) is computed by a series; its relative error there is 2.5e-7."""


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
        del initial
        return _Log(_lower("log", bounds))


@register(position=2)
@dataclass(frozen=True)
class Logit:
    """u = log(t / (1 − t)) with the relative position t = (x − low) / (high − low) between two bounds.

    A step η changes x by η t (1 − t) (high − low): η times a quarter of the range in the middle, and less towards either bound.
    """

    def transform(self, bounds: Bounds, initial: np.ndarray) -> Transform:
        del initial
        low, high = bounds
        if low is None or high is None:
            raise InputError(
                f"logit needs a lower and an upper bound, got {_shown(bounds)}; give bounds, such as [0, 1]"
            )
        return _Logit(low, high - low)


@register(position=3)
@dataclass(frozen=True)
class Softplus:
    """x = low + s log(1 + e^u), which acts as `Log` for x − low below the scale s and linearly, with steps η s, well above it.

    Use it for positive values that may nearly vanish in places, such as a grid of extinction.

    Args:
        scale: s, in the parameter's unit, > 0. None takes the root mean square distance of the initial values from the bound, or 1 if
            that is 0.
    """

    scale: float | None = None

    def __post_init__(self):
        if self.scale is not None:
            checks.number("Softplus", "scale", self.scale, above=0.0)

    def transform(self, bounds: Bounds, initial: np.ndarray) -> Transform:
        low = _lower("softplus", bounds)
        if self.scale is not None:
            return _Softplus(low, float(self.scale))
        squares = np.square(np.asarray(initial, np.float64) - low)
        return _Softplus(low, float(np.sqrt(squares.mean())) if squares.any() else 1.0)


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


@dataclass(frozen=True)
class _Logit:
    low: float
    range: float

    def forward(self, u: Array) -> Array:
        return self.range / (arrays.exp(arrays.clip(-u, -_LARGEST, _LARGEST)) + 1.0) + self.low

    def inverse(self, x: Array) -> Array:
        below, above = self._parts(x)
        return arrays.log(below) - arrays.log(above)

    def slope(self, x: Array) -> Array:
        below, above = self._parts(x)
        return below * above * self.range

    def curvature(self, x: Array) -> Array:
        below, above = self._parts(x)
        return below * above * (above - below) * self.range

    def _parts(self, x: Array) -> tuple[Array, Array]:
        """Return t and 1 − t."""
        below = (x - self.low) * (1.0 / self.range)
        return below, (self.low + self.range - x) * (1.0 / self.range)


@dataclass(frozen=True)
class _Softplus:
    low: float
    scale: float

    def forward(self, u: Array) -> Array:
        small = arrays.exp(-arrays.minimum(arrays.absolute(u), _LARGEST))
        series = small * (1.0 - small * (0.5 - small * (1 / 3)))
        smooth = arrays.where(small < _SMALL, series, arrays.log(small + 1.0))
        return (arrays.maximum(u, 0.0) + smooth) * self.scale + self.low

    def inverse(self, x: Array) -> Array:
        y = (x - self.low) * (1.0 / self.scale)
        near = arrays.minimum(y, _SERIES)
        series = arrays.log(near) + near * (near * (1 / 24) + 0.5)
        far = arrays.maximum(y, _SERIES)
        return arrays.where(y < _SERIES, series, far + arrays.log(1.0 - arrays.exp(-far)))

    def slope(self, x: Array) -> Array:
        return self._share(x) * self.scale

    def curvature(self, x: Array) -> Array:
        share = self._share(x)
        return share * (1.0 - share) * self.scale

    def _share(self, x: Array) -> Array:
        """Return 1 / (1 + e^-u) = 1 − e^(−y) for y = (x − low) / s."""
        y = (x - self.low) * (1.0 / self.scale)
        series = y * (1.0 - y * (0.5 - y * (1 / 6 - y * (1 / 24))))
        return arrays.where(y < _SERIES, series, 1.0 - arrays.exp(-arrays.maximum(y, _SERIES)))


def _lower(name: str, bounds: Bounds) -> float:
    low, _ = bounds
    if low is None:
        raise InputError(f"{name} needs a lower bound, got {_shown(bounds)}; give bounds, such as [0, inf]")
    return low


def _shown(bounds: Bounds) -> str:
    low, high = (("open" if side is None else f"{side:g}") for side in bounds)
    return f"bounds {low} to {high}"
