"""Formatting of numbers for display."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

LISTED = 4
"""Maximum number of elements of an array that are listed one by one."""
_MOST_LISTED = 12
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_UNKNOWN = "–"
_ROUNDING = 2.0**-24  # relative rounding error of float32


def number(value: float | None) -> str:
    """Format a value with three significant digits: 0.0213, 1.5, −2.27·10⁻⁹, ∞; a dash for None and NaN."""
    if value is None or value != value:
        return _UNKNOWN
    sign, size = ("−" if value < 0 else ""), abs(value)
    if size == float("inf"):
        return f"{sign}∞"
    if size == 0 or 1e-4 <= size < 1e5:
        text = f"{size:.3g}"
        return sign + (f"{size:.0f}" if "e" in text else text)
    mantissa, exponent = f"{size:.2e}".split("e")
    mantissa, power = mantissa.rstrip("0").rstrip("."), "10" + str(int(exponent)).translate(_SUPERSCRIPTS)
    return sign + (power if mantissa == "1" else f"{mantissa}·{power}")


def count(value: float) -> str:
    """Format a large number with a unit: 500, 20 k, 1.5 M."""
    for size, unit in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= 0.9995 * size:  # three digits of anything from here on round to the next unit
            return f"{value / size:.3g} {unit}"
    return f"{value:.3g}"


def duration(seconds: float | None) -> str:
    """Format a duration: 12.3 s, 3 min 20 s, 1 h 05 min; a dash for None."""
    if seconds is None:
        return _UNKNOWN
    rounded = round(seconds)
    if rounded < 60:
        return f"{seconds:.3g} s"
    if rounded < 3600:
        return f"{rounded // 60} min {rounded % 60:02d} s"
    return f"{rounded // 3600} h {rounded % 3600 // 60:02d} min"


def deviation(standard_error: float | None) -> str:
    """Format a standard error: 0.012; "not determined" for None and infinity."""
    finite = standard_error is not None and math.isfinite(standard_error)
    return number(standard_error) if finite else "not determined"


def values(array: np.ndarray, standard_error: Sequence[float | None] | None = None) -> str:
    """Format up to four elements, each with its standard error if known; of more elements, the minimum and the maximum."""
    if array.size == 0:
        return ""
    if array.size > LISTED:
        return " … ".join(number(float(value)) for value in (array.min(), array.max()))
    numbers = [float(value) for value in array.reshape(-1)]
    if standard_error is None or len(standard_error) != len(numbers):
        return ", ".join(map(number, numbers))
    texts = [
        with_standard_error(value, error)
        if error is not None and math.isfinite(error)
        else f"{number(value)} ({deviation(error)})"
        for value, error in zip(numbers, standard_error, strict=True)
    ]
    return ", ".join(texts)


def few_values(
    parameters: Mapping[str, np.ndarray], standard_error: Mapping[str, Sequence[float | None]]
) -> dict[str, str]:
    """Return {key: values with their standard errors where known} of parameters of at most 4 elements, up to 12 numbers in all."""
    few, listed = {}, 0
    for key, array in parameters.items():
        if 0 < array.size <= LISTED and listed + array.size <= _MOST_LISTED:
            listed += array.size
            few[key] = values(array, standard_error.get(key))
    return few


def with_error(value: float, error: float) -> str:
    """Format the value and error of `debiased.rmse`: 0.0312 ± 0.0004.

    A value within two errors of 0 becomes a limit, the root of the sum of their squares: below 0.012. It is a limit only for
    `debiased.rmse`, whose error is then the root of two standard errors of the mean square. Others need `with_standard_error`.
    """
    if 0 < error < math.inf and value <= 2 * error:
        return f"below {number(math.hypot(value, error))}"
    return with_standard_error(value, error)


def with_standard_error(value: float, error: float) -> str:
    """Format a value, which may be negative, with its standard error, if that is finite and no rounding: 0.0018 ± 0.0019."""
    if not (math.isfinite(value) and math.isfinite(error)) or error <= _ROUNDING * abs(value):
        return number(value)
    places = min(max(1 - math.floor(math.log10(error)), 0), 12)  # two digits of the error
    if abs(value) >= 1e5 or error < 1e-6:
        return f"{number(value)} ± {number(error)}"
    return f"{value:.{places}f} ± {error:.{places}f}".replace("-", "−")


def phases(seconds: Mapping[str, float]) -> str:
    """Format the seconds of each phase: "loading 2.1 s, steps 30 s". Phases below both 0.05 s and 1 % of the total are omitted."""
    least = min(0.05, 0.01 * sum(seconds.values()))
    return ", ".join(f"{name} {duration(float(f'{spent:.2g}'))}" for name, spent in seconds.items() if spent >= least)
