"""Checks of numbers, flags and text from the user, each failure one line with the field's name and the expected value."""

from __future__ import annotations

import dataclasses
import errno
import functools
import inspect
import logging
import math
import os
import sys
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from unrender.core import registry
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, in_words, printable, reason_of

LARGEST = (1 << 63) - 1
"""Largest whole number that the files of a run hold."""
Positive = Annotated[float, 0.0]
"""Annotation of a field: a finite number > 0."""
NotNegative = Annotated[float, 0.0, math.inf, True]
"""A finite number >= 0."""
Fraction = Annotated[float, 0.0, 1.0, True]
"""A number in [0, 1)."""
OpenFraction = Annotated[float, 0.0, 1.0]
"""A number in (0, 1)."""
PositiveByKey = Annotated[Mapping[str, float], 0.0]
"""{key of a parameter: a finite number > 0}."""
Index = Annotated[int, 0]
Count = Annotated[int, 1]
Several = Annotated[int, 2]
"""Whole numbers of at least 0, 1 and 2, below 2³²."""
Seed = Annotated[int, 0, LARGEST]


def number(
    owner: str, name: str, value: Any, above: float = -math.inf, below: float = math.inf, inclusive: bool = False
) -> float:
    """Return a finite float in (above, below), or in [above, below) with `inclusive`. Raises `InputError` that names `owner` and `name`."""
    number = real(value)
    if math.isfinite(number) and (above < number < below or (inclusive and number == above)):
        return number
    limits = [f"{'>=' if inclusive else '>'} {above:g}"] if above > -math.inf else []
    limits += [f"< {below:g}"] if below < math.inf else []
    raise InputError(
        f"{owner}: {name} must be a finite number {' and '.join(limits)}".rstrip() + f", got {in_words(value)}"
    )


def real(value: Any) -> float:
    """Return a number as a float, infinite if it is too large for one; NaN for a value that is no number."""
    try:
        return float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    except OverflowError:
        return -math.inf if value < 0.0 else math.inf


def path(where: str, value: Any, what: str = "a folder") -> Path:
    """Return the path of a file or folder, else raise `InputError`, also for a name that is too long. "" would be the current folder."""
    if not isinstance(value, (str, os.PathLike)) or value == "" or "\0" in os.fspath(value):
        raise InputError(f"{where}: expected {what}, got {in_words(value)}")
    try:
        os.lstat(value)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise InputError(f"{where}: {in_words(value)}: {error.strerror}") from error
    return Path(value)


def optional(where: str, value: Any, kind: type, what: str) -> None:
    """Raise `InputError` unless `value` is None or an instance of `kind`."""
    if value is not None and not isinstance(value, kind):
        raise InputError(f"{where}: expected {what}, got {in_words(value)}")


def limits(low: float | None, high: float | None) -> list[str]:
    """Return the ends of a range in words, for messages; None is open."""
    return [f"{word} {end:g}" for word, end in (("at least", low), ("at most", high)) if end is not None]


def integer(owner: str, name: str, value: Any, at_least: int, at_most: int = (1 << 32) - 1) -> int:
    """Return `value` as an integer in [`at_least`, `at_most`], else raise `InputError`. Dr.Jit counts below 2³²."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if whole and at_least <= int(value) <= at_most:
        return int(value)
    limit = f"at most {at_most}" if whole and int(value) > at_most else f"a whole number of at least {at_least}"
    raise InputError(f"{owner}: {name} must be {limit}, got {in_words(value)}")


def flag(owner: str, name: str, value: Any) -> None:
    """Raise `InputError` unless `value` is true or false."""
    if type(value).__name__ not in ("bool", "bool_"):
        raise InputError(f"{owner}: {name} must be true or false, got {in_words(value)}")


def choice(owner: str, name: str, value: Any, *choices: str) -> None:
    """Raise `InputError` unless `value` is one of `choices`."""
    if not isinstance(value, str) or value not in choices:
        words = " or ".join(", ".join(f'"{each}"' for each in choices).rsplit(", ", 1))
        raise InputError(f"{owner}: {name} must be {words}, got {in_words(value)}{did_you_mean(value, choices)}")


def by_key(owner: str, name: str, values: Any, above: float) -> None:
    """Raise `InputError` unless `values` is {key of a parameter: finite number > `above`}."""
    if not isinstance(values, Mapping) or not all(isinstance(key, str) for key in values):
        raise InputError(f"{owner}: {name} must be numbers by key, {{key: number}}, got {in_words(values)}")
    for key, value in values.items():
        number(owner, f"{name} of {key}", value, above)


def component(owner: str, name: str, value: Any, expected: str, *kinds: type) -> None:
    """Raise `InputError` unless `value` is of one of these classes, or has the methods of the components of one of these protocols."""
    protocols = [registry.kind_of_protocol(kind) for kind in kinds]
    if not any(
        isinstance(value, kind) if protocol is None else registry.implements(value, protocol)
        for kind, protocol in zip(kinds, protocols, strict=True)
    ):
        raise InputError(f"{owner}: {name} must be {expected}, got {in_words(value)}")


def fields(part: Any, owner: str = "") -> None:
    """Raise `InputError` unless each field of a dataclass instance fits its annotation.

    Checked are the ranges above, `bool`, `Literal` and components, each also with `| None`. `owner` is the name in messages; "" is the
    class's.
    Numbers of other types, such as NumPy's, become Python's: Mitsuba takes no others.
    """
    for name, check, limits, optional in _checked(type(part)):
        value = getattr(part, name)
        if optional and value is None:
            continue
        checked = check(owner or type(part).__name__, name, value, *limits)
        if checked is not None and type(value) not in (int, float):
            object.__setattr__(part, name, checked)


class Checked:
    """Base of dataclasses without other checks than those of `fields`."""

    def __post_init__(self) -> None:
        fields(self)


@functools.cache
def _checked(kind: type) -> list[tuple[str, Callable[..., Any], tuple[Any, ...], bool]]:
    """Return (field, check, its limits, whether the field may be None) of the fields of a dataclass that have a check."""
    found = []
    for field in dataclasses.fields(kind):
        annotation: Any = field.type
        if isinstance(annotation, str):
            home = next(base for base in kind.__mro__ if field.name in inspect.get_annotations(base))
            try:  # each alone, since some names are imported for type checkers only
                annotation = eval(annotation, vars(sys.modules[home.__module__]))
            except (NameError, TypeError):
                continue
        kinds = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
        others = [each for each in kinds if each is not NoneType]
        limits = tuple(limit for each in others for limit in get_args(each))
        if others == [bool]:
            found.append((field.name, flag, (), len(kinds) > 1))
        elif all(get_origin(each) is Literal for each in others):
            found.append((field.name, choice, limits, len(others) < len(kinds)))
        elif len(others) == 1 and get_origin(others[0]) is Annotated:
            check = {int: integer, float: number}.get(limits[0], by_key)
            found.append((field.name, check, limits[1:], len(kinds) > 1))
        elif all(words := [_expected(each) for each in others]):
            none = NoneType in kinds
            expected = " or ".join([*words, "None"] if none else words)
            found.append((field.name, component, (expected, *others), none))
    return found


def _expected(annotation: Any) -> str:
    """Return in words which components an annotation allows; "" if it is no component and no protocol of them with methods."""
    kind = registry.KINDS.get(registry.kind_of_protocol(annotation) or "")
    if kind is not None:
        return f"one of {kind.package}" if kind.members else ""
    name = getattr(annotation, "__name__", "")
    known = registry.component_of(annotation)
    return "" if known is None else f"{'an' if name[0] in 'AEIO' else 'a'} {name}"


def encode_text(text: str, where: str) -> bytes:
    """Return UTF-8. Raises `InputError` for lone surrogates, as in file names that are not UTF-8."""
    try:
        return text.encode()
    except UnicodeEncodeError as error:
        part = printable(text[max(error.start - 20, 0) : error.start + 20])
        raise InputError(f"{where}: a name that is not UTF-8 ({part}); rename the file or folder") from error


def without_effect(component: Any, names: tuple[str, ...], needs: str) -> None:
    """Raise `InputError` for one of these fields of a dataclass that nothing reads and that differs from its default."""
    for field in dataclasses.fields(component):
        if field.name in names and getattr(component, field.name) != field.default:
            raise InputError(
                f"{type(component).__name__}: {field.name} has no effect here; it needs {needs}, or its default {field.default!r}"
            )


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


def array_like(value: Any, advice: str) -> Any:
    """Return a value for `numpy.asarray`, which refuses tensors of PyTorch that require gradients or are on a GPU.

    Raises `InputError` with advice for a NumPy array of which some elements are masked: as an array they are values like others.
    """
    import numpy as np  # a command that only says its version does without

    if isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any():
        raise InputError(f"a masked array has values that do not count: {advice}")
    detach = getattr(value, "detach", None)
    return value if detach is None or not hasattr(value, "cpu") else detach().cpu()


def as_array(value: Any, owner: str, what: str = "an array of numbers") -> Any:
    """Return `numpy.asarray(value)`. Raises `InputError` that begins with `owner` and says `what` was expected."""
    import numpy as np

    try:
        return np.asarray(value)
    except (TypeError, ValueError) as error:
        ragged = "inhomogeneous" in str(error)
        got = "rows of different lengths" if ragged else f"{type(value).__name__}: {reason_of(error, 100)}"
        raise InputError(f"{owner}expected {what}, got {got}") from error


_FILE = ", or give the picture's file as initial value"


def refuse_encoded(values: Any, where: str = "", otherwise: str = _FILE) -> None:
    """Raise `InputError` that begins with `where` for an array of several unsigned integers of 8 or 16 bits above 1, the levels of a
    picture; `otherwise` ends its advice."""
    if str(values.dtype) in ("uint8", "uint16") and values.size > 1 and values.max() > 1:
        raise InputError(
            f"{where}expected linear values, got integers of 8 or 16 bits up to {values.max():g}, as pictures are stored: convert them to "
            f"linear floating-point values{otherwise}"
        )
