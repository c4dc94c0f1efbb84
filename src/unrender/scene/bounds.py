"""Bounds of parameters: validation, restriction to one side of a singular value, and projection."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.text import in_words, listed
from unrender.core.trees import Tree
from unrender.parameterisations import Bounds
from unrender.rendering.renderer import ParameterInfo

MARGIN = 1e-4
"""Margin that `project` keeps from a bound, as a fraction of the range (of `open_scale` if it is unbounded).

At reflectance 0 no light passes a surface, so its gradient stays 0. A lobe of probability 0 is never sampled again.
"""
_LOBE_START = 0.01
"""Distance from an end of the range, as a fraction of it, to which a start is moved if a lobe would never be sampled."""
_ROUNDING = 1e-6
"""Distance of a true value from the bounds that rounding explains, relative to the largest value or to 1."""
_HALF_PRECISION = 2.0**-11  # largest relative change of a value that is rounded to half precision
_CLEARANCE = 0.01
"""Distance to a singular value that bounds keep, relative to that value; at most half of the initial distance."""

_LARGEST = float(np.finfo(np.float32).max)
_FULL_TURN = 2.0 * math.pi + 1e-4  # largest angle in radians that is plausible, with a margin for rounding


def ends_of(bounds: Bounds) -> tuple[float, float]:
    """Return both bounds as numbers, infinite where there is none."""
    low, high = bounds
    return -math.inf if low is None else float(low), math.inf if high is None else float(high)


def check_bounds(bounds: Any, info: ParameterInfo, start: np.ndarray) -> tuple[Bounds, str]:
    """Return the bounds of a parameter, and a notice of how they were narrowed; "" if they were not.

    Args:
        bounds: (low, high), where either may be None or infinite; None for the physical range.
        info: the renderer's description of the parameter.
        start: initial values, which determine the side of a singular value.

    Raises:
        InputError: the bounds are malformed or outside of the physical range, or the initial values are at a singular value or on both
            sides of it.
    """
    low, high = (info.lowest, info.highest) if bounds is None else _read(bounds)
    if any(a is not None and b is not None and a >= b for a, b in ((low, info.highest), (info.lowest, high))):
        raise InputError(
            f"no range of values is within {_interval((low, high))} and its range {_interval((info.lowest, info.highest))}"
        )
    if info.singular is None or not (_below(low, info.singular) and _below(info.singular, high)):
        return (low, high), ""
    singular = info.singular
    if (start == singular).any() or ((start < singular).any() and (start > singular).any()):
        raise InputError(
            f"images are singular at {singular:g}: expected initial values on one side of it, got {_span(start)}"
        )
    gap = min(_CLEARANCE * abs(singular), float(np.min(np.abs(start - singular), initial=np.inf)) / 2)
    above = start.flat[0] > singular
    side = (singular + gap, high) if above else (low, singular - gap)
    if bounds is None and above:  # as nearly all materials are
        return side, ""
    return side, f"bounds narrowed to {_interval(side)}: images are singular at {singular:g}"


def clip_to_bounds(start: np.ndarray, bounds: Bounds, half: bool = False) -> tuple[np.ndarray, str]:
    """Return `start` clamped to the bounds, and a notice with the number of changed values; "" if none changed.

    The notice ignores changes that undo the rounding of a value at a bound, if `start` was rounded to half precision (`half`).
    """
    low, high = bounds
    if not _outside(start, bounds)[0]:
        return start, ""
    clipped = np.asarray(np.clip(start, low, high), np.float32)  # clip returns a scalar for a scalar
    moved, ends = _outside(start, bounds, half=half)
    if not moved:
        return clipped, ""
    example = f"{'such as ' if moved > len(ends) else ''}{listed([f'{value:g} to {end:g}' for value, end in ends])}"
    return clipped, f"{moved} of {start.size} initial values moved into the bounds {_interval(bounds)}: {example}"


def truth_notice(truth: np.ndarray, bounds: Bounds, half: bool = False) -> str:
    """Return a notice of true values outside the bounds, beyond rounding, to half precision if `half`; "" for none."""
    count, ends = _outside(truth, bounds, _ROUNDING * max(float(np.abs(truth).max(initial=0.0)), 1.0), half)
    if not count:
        return ""
    example = f"{'such as ' if count > len(ends) else ''}{listed([f'{value:g}' for value, _ in ends])}"
    return (
        f"has {count} of {truth.size} values outside the bounds {_interval(bounds)}, which no run can reach: {example}"
    )


def _outside(
    values: np.ndarray, bounds: Bounds, margin: float = 0.0, half: bool = False
) -> tuple[int, list[tuple[float, float]]]:
    """Return the number of values outside the bounds by more than a margin, and the furthest beyond each end with that end.

    The margin is larger for values that were rounded to half precision (`half`).
    """
    count, ends = 0, []
    for sign, end in zip((-1.0, 1.0), bounds, strict=True):
        if end is None:
            continue
        most = margin + (_HALF_PRECISION * abs(end) if half else 0.0)
        if (beyond := sign * (values - np.float32(end)) > most).any():
            count += int(np.count_nonzero(beyond))
            ends.append((float(sign * np.max(sign * values)), end))
    return count, ends


def open_scale(initial: np.ndarray) -> float:
    """Return the scale of values whose range is unbounded: the largest initial magnitude, at most 1; 1 if all are 0."""
    return min(1.0, float(np.abs(initial).max(initial=0.0))) or 1.0


def project(x: Array, low: float | None, high: float | None, scale: float = 1.0) -> Array:
    """Project onto the bounds, with a margin. A projection, unlike a sigmoid, does not change the gradient inside the bounds.

    Args:
        low: lower bound; None if unbounded.
        high: upper bound; None if unbounded.
        scale: scale of the margin if the range is unbounded, see `open_scale`.
    """
    low, high = _kept(low, high, scale)
    if low is not None:
        x = arrays.maximum(x, low)
    if high is not None:
        x = arrays.minimum(x, high)
    return x


def sides_of_bounds(x: Array, low: float | None, high: float | None, scale: float = 1.0) -> Array:
    """Return -1 for elements that `project` keeps at the lower bound, 1 for those at the upper one, and 0 for the others."""
    low, high = _kept(low, high, scale)
    sides = arrays.zeros_like(x)
    if low is not None:
        sides = arrays.where(x <= low, sides - 1.0, sides)
    if high is not None:
        sides = arrays.where(x >= high, sides + 1.0, sides)
    return sides


def _kept(low: float | None, high: float | None, scale: float) -> Bounds:
    """Return the bounds less the margin."""
    margin = MARGIN * (high - low if low is not None and high is not None else scale)
    return None if low is None else low + margin, None if high is None else high - margin


def angle_notice(info: ParameterInfo, *values: Any) -> str:
    """Return a notice of angles above a full turn, which may be degrees; "" for none. Infinite values and None are ignored."""
    if not info.angle:
        return ""
    sizes = [np.abs(np.asarray(value, np.float64)) for value in values if value is not None]
    largest = max((float(size[np.isfinite(size)].max(initial=0.0)) for size in sizes), default=0.0)
    if largest <= _FULL_TURN:
        return ""
    return f"{largest:g} radians is more than a full turn; if it is in degrees, give {math.radians(largest):.4g}"


def move_inside(start: np.ndarray, bounds: Bounds, info: ParameterInfo) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return a start inside the bounds at which each lobe is sampled, and notices of the changes."""
    start, moved = _sampled_lobe(start, info)
    start, clipped = clip_to_bounds(start, bounds, info.conversion.half)
    return start, tuple(filter(None, (moved, clipped)))


def _sampled_lobe(start: np.ndarray, info: ParameterInfo) -> tuple[np.ndarray, str]:
    """Return a start, moved off an end where none of its values ever samples a lobe, and a notice of that, "" for none."""
    low, high = info.lowest, info.highest
    if not info.lobe or low is None or high is None or not start.size:
        return start, ""
    margin, inside = MARGIN * (high - low), _LOBE_START * (high - low)
    for end, value in ((low, low + inside), (high, high - inside)):
        if (np.abs(start - end) <= margin).all():
            notice = f"initial values moved from {end:g} to {value:g}: at {end:g} one of the surface's lobes is never sampled"
            return np.full_like(start, value), notice
    return start, ""


def off_ends(values: Tree, known: Mapping[str, ParameterInfo]) -> Tree:
    """Return the values, where those within `MARGIN` of an end of a closed physical range are moved inside by it.

    Gradients are wrong at an end: no light comes back from a black surface, and no path takes a lobe of probability 0.
    """
    moved = {key: _off_ends(x, known[key].lowest, known[key].highest) for key, x in values.items()}
    arrays.evaluate(moved)
    return moved


def _off_ends(x: Array, low: float | None, high: float | None) -> Array:
    if low is None or high is None:
        return x
    margin = MARGIN * (high - low)
    for end, inside in ((low, low + margin), (high, high - margin)):
        x = arrays.where(arrays.absolute(x - end) < margin, x * 0.0 + inside, x)
    return x


def _read(bounds: Any) -> Bounds:
    bounds = checks.array_like(bounds, "give (low, high), either may be None")
    bounds = bounds.tolist() if hasattr(bounds, "tolist") else bounds
    if isinstance(bounds, (str, bytes)) or not isinstance(bounds, Sequence) or len(bounds) != 2:
        raise InputError(f"expected (low, high), either may be None, got {in_words(bounds)}")
    for side in bounds:
        if side is not None and math.isnan(checks.real(side)):
            raise InputError(f"expected two numbers or None, got {in_words(side)}")
    low, high = (None if side is None else _single(checks.real(side)) for side in bounds)
    if low == math.inf or high == -math.inf:
        given = " and ".join(map(in_words, bounds))
        raise InputError(f"low must be less than high, with numbers up to {_LARGEST:.3g} between, got {given}")
    low, high = None if low == -math.inf else low, None if high == math.inf else high
    if low is not None and high is not None and low >= high:
        raise InputError(f"low must be less than high, got {low:g} and {high:g}")
    return low, high


def _single(side: float) -> float:
    """Return a bound, infinite beyond the range of single precision, in which the values are."""
    return side if abs(side) <= _LARGEST else math.copysign(math.inf, side)


def _below(low: float | None, high: float | None) -> bool:
    """Return whether one limit is at most the other; None is unbounded."""
    return low is None or high is None or low <= high


def _interval(bounds: Bounds) -> str:
    return f"[{', '.join('open' if end is None else f'{end:g}' for end in bounds)}]"


def _span(values: np.ndarray) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
