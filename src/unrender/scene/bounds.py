"""Bounds of parameters: checked, narrowed to one side of a singular value, and projected onto."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.parameterisations.base import Bounds
from unrender.rendering.renderer import ParameterInfo

MARGIN = 1e-4
"""Distance from a bound at which parameters are clamped, as a fraction of their range (of 1 where it is open). At a reflectance of
exactly 0 no light arrives through a surface and its gradient is 0 for ever; a lobe of probability exactly 0 is never sampled again."""
_CLEARANCE = 0.01
"""Distance that values keep from a singular value, as a share of it: at most half of the initial distance."""


def check_bounds(given: Any, info: ParameterInfo, start: np.ndarray) -> tuple[Bounds, str]:
    """Return the bounds of a parameter, and a notice of how they were narrowed, "" for not at all.

    Args:
        given: (low, high), either may be None or infinite; None for the physical range.
        info: what the renderer says of the parameter.
        start: initial values; they decide on which side of a singular value the bounds are.

    Raises:
        InputError: the bounds are malformed, or the initial values are at a singular value or on both sides of it.
    """
    low, high = (info.lowest, info.highest) if given is None else _read(given)
    if info.singular is None or not (_below(low, info.singular) and _below(info.singular, high)):
        return (low, high), ""
    middle = info.singular
    if (start == middle).any() or ((start < middle).any() and (start > middle).any()):
        raise InputError(
            f"images are singular at {middle:g}: expected initial values on one side of it, got {_span(start)}"
        )
    gap = min(_CLEARANCE * abs(middle), float(np.min(np.abs(start - middle), initial=np.inf)) / 2)
    side = (middle + gap, high) if start.flat[0] > middle else (low, middle - gap)
    if given is None:
        return side, ""
    shown = ", ".join("open" if end is None else f"{end:g}" for end in side)
    return side, f"bounds narrowed to [{shown}]: images are singular at {middle:g}"


def clip_to_bounds(start: np.ndarray, bounds: Bounds) -> tuple[np.ndarray, str]:
    """Return `start` inside the bounds, and a notice of how many values changed, "" for none."""
    low, high = bounds
    moved = sum(
        int(np.count_nonzero(outside(start, end)))
        for outside, end in ((np.less, low), (np.greater, high))
        if end is not None
    )
    if not moved:
        return start, ""
    notice = f"{moved} of {start.size} initial values moved into the bounds [{low}, {high}]"
    return np.asarray(np.clip(start, low, high), np.float32), notice  # of a number, clip returns no array


def project(x: Array, low: float | None, high: float | None) -> Array:
    """The nearest point inside the bounds, less the margin. A projection, not a sigmoid: the gradient inside is untouched."""
    margin = MARGIN * (high - low if low is not None and high is not None else 1.0)
    if low is not None:
        x = arrays.maximum(x, low + margin)
    if high is not None:
        x = arrays.minimum(x, high - margin)
    return x


def _read(given: Any) -> Bounds:
    if isinstance(given, (str, bytes)) or not isinstance(given, Sequence) or len(given) != 2:
        raise InputError(f"expected (low, high), either may be None, got {given!r}")
    for side in given:
        if side is not None and (isinstance(side, bool) or not isinstance(side, (int, float)) or math.isnan(side)):
            raise InputError(f"expected two numbers or None, got {side!r}")
    low, high = (None if side is None else float(side) for side in given)
    if low == math.inf or high == -math.inf:
        raise InputError(f"low must be less than high, got {low} and {high}")
    low, high = None if low == -math.inf else low, None if high == math.inf else high
    if low is not None and high is not None and low >= high:
        raise InputError(f"low must be less than high, got {low:g} and {high:g}")
    return low, high


def _below(low: float | None, high: float | None) -> bool:
    """Whether one end is at most the other; None is open."""
    return low is None or high is None or low <= high


def _span(values: np.ndarray) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
