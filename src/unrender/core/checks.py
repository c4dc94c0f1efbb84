"""Checks of numbers, flags and text from the user, and a count of values that are not finite.

Each failure is one line with the field's name and the expected value.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from numbers import Integral, Real
from typing import Any

from unrender.core.errors import InputError
from unrender.core.text import printable


def number(
    owner: str, name: str, value: Any, above: float = -math.inf, below: float = math.inf, inclusive: bool = False
) -> float:
    """Return `value` as a finite float in (above, below), or in [above, below) with `inclusive`.

    Raises `InputError` that names `owner` (the class or section) and `name` (the argument or field).
    """
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    if math.isfinite(number) and (above < number < below or (inclusive and number == above)):
        return number
    limits = [f"{'>=' if inclusive else '>'} {above:g}"] if above > -math.inf else []
    limits += [f"< {below:g}"] if below < math.inf else []
    raise InputError(f"{owner}: {name} must be a finite number {' and '.join(limits)}".rstrip() + f", got {value!r}")


def limits(low: float | None, high: float | None) -> list[str]:
    """Return the ends of a range in words, for messages; None is open."""
    return [f"{word} {end:g}" for word, end in (("at least", low), ("at most", high)) if end is not None]


def integer(owner: str, name: str, value: Any, at_least: int) -> int:
    """Return `value` as an integer >= `at_least`, else raise `InputError`."""
    if isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= at_least:
        return int(value)
    raise InputError(f"{owner}: {name} must be a whole number of at least {at_least}, got {value!r}")


def flags(part: Any) -> None:
    """Raise `InputError` unless each field of a dataclass instance whose annotation is `bool` is true or false."""
    for field in dataclasses.fields(part):
        if field.type in ("bool", bool) and type(value := getattr(part, field.name)).__name__ not in ("bool", "bool_"):
            raise InputError(f"{type(part).__name__}: {field.name} must be true or false, got {value!r}")


def encode_text(text: str, where: str) -> bytes:
    """Return the text as UTF-8.

    Raises `InputError` for text with lone surrogates. Python reads file names that are not UTF-8 as such text.
    """
    try:
        return text.encode()
    except UnicodeEncodeError as error:
        part = printable(text[max(error.start - 20, 0) : error.start + 20])
        raise InputError(f"{where}: a name that is not UTF-8 ({part}); rename the file or folder") from error


def without_effect(component: Any, names: tuple[str, ...], needs: str) -> None:
    """Raise `InputError` for one of these fields of a dataclass that nothing reads and that differs from its default."""
    for field in dataclasses.fields(component):
        if field.name in names and getattr(component, field.name) != field.default:
            raise InputError(f"{type(component).__name__}: {field.name} has no effect here; it needs {needs}")


_log = logging.getLogger("unrender")


class DropReport:
    """Counter of dropped values. Logs a warning at the first one and at every tenfold count.

    Attributes:
        count: number of values dropped so far.
        total: number of values seen so far.
    """

    def __init__(self) -> None:
        self.count, self.total = 0, 0
        self._reported = 0

    def add(self, dropped: int, of: int, reason: str) -> None:
        """Record that `dropped` of `of` values were not finite; `reason` names them in the warning."""
        self.count += dropped
        self.total += of
        if self.count >= max(1, 10 * self._reported):
            self._reported = self.count
            _log.warning("%s; %d of %d so far were dropped", reason, self.count, self.total)
