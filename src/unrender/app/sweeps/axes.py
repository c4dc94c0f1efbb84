"""What a sweep varies: the values of one option, or the range they are drawn from."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from unrender.core.errors import InputError
from unrender.methods.base import Method

_DIGITS = 4
"""Significant digits of numbers from a range, so that they can be typed again."""
_MOST_POINTS = 10_000


@dataclass(frozen=True)
class Axis:
    """An option and what it may be.

    Attributes:
        name: of the option.
        text: as it was typed, after NAME=.
        choices: the values as text; () for a range.
        low, high: ends of a range, both included.
        logarithmic: whether a range is even in the logarithm.
        count: points of a range on a grid; None where none were given.
        integer: whether a range holds whole numbers alone.
    """

    name: str
    text: str
    choices: tuple[str, ...] = ()
    low: float = 0.0
    high: float = 0.0
    logarithmic: bool = False
    count: int | None = None
    integer: bool = False

    def at(self, share: float) -> str:
        """The value at a share in [0, 1) of the axis: shares drawn evenly give each choice, or whole number, its even chance."""
        if self.choices:
            return self.choices[min(int(share * len(self.choices)), len(self.choices) - 1)]
        low, high = (self.low - 0.5, self.high + 0.5) if self.integer else (self.low, self.high)
        return self.typed(self._between(max(low, 0.5) if self.integer and self.logarithmic else low, high, share))

    def typed(self, number: float) -> str:
        """A number of the range as text: rounded, within the ends."""
        if self.integer:
            return str(int(min(max(round(number), self.low), self.high)))
        return repr(min(max(float(f"{number:.{_DIGITS}g}"), self.low), self.high))

    def points(self) -> tuple[str, ...]:
        """The values on a grid, without repetition. Raises `InputError` for a range without a number of points."""
        if self.choices:
            return self.choices
        if self.count is None:
            if not self.integer or self.logarithmic or self.high - self.low >= _MOST_POINTS:
                raise InputError(
                    f"--over {self.name}={self.text}: on a grid, a range needs a number of points ({self.text}:5)"
                )
            return tuple(str(n) for n in range(int(self.low), int(self.high) + 1))
        ends = max(self.count - 1, 1)
        found = [self.typed(self._between(self.low, self.high, i / ends)) for i in range(self.count)]
        return tuple(dict.fromkeys(found))

    def _between(self, low: float, high: float, share: float) -> float:
        if self.logarithmic:
            return math.exp(math.log(low) + share * (math.log(high) - math.log(low)))
        return low + share * (high - low)


def parse_axes(
    given: Iterable[str] | Mapping[str, str | Sequence[Any]], method: Method, fixed: Iterable[str] = ()
) -> tuple[Axis, ...]:
    """Return the axes of a sweep.

    Args:
        given: `NAME=VALUE,VALUE` and `NAME=LOW:HIGH[:log][:POINTS]`; or by name, the text after `NAME=` or a list of values.
        method: whose options they are; every value must be one that it takes.
        fixed: options that are set already.

    Raises:
        InputError: none is given, or one is malformed, given twice, fixed already, or no option of the method.
    """
    found = []
    taken = set(fixed)
    for name, values in (given if isinstance(given, Mapping) else _by_name(given)).items():
        if name in taken:
            raise InputError(f"--over {name}: it is fixed by --set")
        if isinstance(values, str):
            found.append(_range(name, values, method) or _choices(name, values, _split(values), method))
        else:
            listed = [as_text(value) for value in values]
            found.append(_choices(name, ",".join(listed), listed, method))
    if not found:
        raise InputError("sweep: nothing to vary; give --over NAME=VALUE,VALUE or --over NAME=LOW:HIGH")
    return tuple(found)


def as_text(value: Any) -> str:
    """Return a value of an option as sweep.json and the command line hold it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _by_name(given: Iterable[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for text in given:
        name, equals, values = (part.strip() for part in text.partition("="))
        if not (equals and name and values):
            raise InputError(f"--over {text}: expected NAME=VALUE,VALUE or NAME=LOW:HIGH[:log][:POINTS]")
        if name in found:
            raise InputError(f"--over {text}: {name} is given twice")
        found[name] = values
    return found


def _choices(name: str, text: str, values: Sequence[str], method: Method) -> Axis:
    choices = tuple(part.strip() for part in values)
    for choice in choices:
        if not choice:
            raise InputError(f"--over {name}={text}: a value is empty")
        if choices.count(choice) > 1:
            raise InputError(f"--over {name}={text}: {choice} is given twice")
        if len(_split(choice)) > 1:
            raise InputError(f"--over {name}={text}: {choice} has a comma, which separates values")
        method.configure({name: choice})
    return Axis(name, text, choices)


def _split(values: str) -> list[str]:
    """At commas that stand in no parentheses: "cosine(300),steps(100, 0.5)" are two."""
    parts, depth = [""], 0
    for character in values:
        depth += (character == "(") - (character == ")")
        if character == "," and depth <= 0:
            parts.append("")
        else:
            parts[-1] += character
    return parts


def _range(name: str, values: str, method: Method) -> Axis | None:
    """The range, or None for what is none: no two numbers first, apart by a colon."""
    low_text, colon, rest = values.partition(":")
    high_text, *extras = rest.split(":")
    try:
        low, high = float(low_text), float(high_text)
    except ValueError:
        return None
    if not colon:
        return None
    where = f"--over {name}={values}"
    logarithmic = "log" in extras
    counts = [extra for extra in extras if extra != "log"]
    if len(extras) > 1 + logarithmic or any(not (c.isascii() and c.isdigit()) for c in counts):
        raise InputError(f"{where}: expected LOW:HIGH[:log][:POINTS]")
    count = int(counts[0][:7]) if counts else None
    if count is not None and not 1 <= count <= _MOST_POINTS:
        raise InputError(f"{where}: expected from 1 to {_MOST_POINTS} points, got {count}")
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(f"{where}: expected two finite numbers, the lower one first")
    if logarithmic and low <= 0:
        raise InputError(f"{where}: a logarithmic range must begin above 0")
    whole = _is_whole(name, method)
    for end in (low, high):
        if whole and end != int(end):
            raise InputError(f"{where}: expected whole numbers, got {end:g}")
        method.configure({name: int(end) if whole else end})
    return Axis(name, values, (), low, high, logarithmic, count, whole)


def _is_whole(name: str, method: Method) -> bool:
    """Whether the option takes whole numbers and no others. Raises `InputError` for text and the like, or an unknown option."""
    if name not in method.options.model_fields:
        method.configure({name: 0})  # says so
    words = method.expected(name)
    if "a number" not in words and "a whole number" not in words:
        raise InputError(f"--over {name}: a range needs an option that is a number, {name} is {words}")
    return "a number" not in words
