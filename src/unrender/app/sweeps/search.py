"""The axes of a sweep, and its search: all points of a grid, random settings, or proposals of a model of the earlier trials."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.methods.base import Method

_DIGITS = 4  # significant digits of numbers from a range, so that they are short to type
_MOST_POINTS = 10_000


@dataclass(frozen=True)
class Axis:
    """An option and its possible values.

    Attributes:
        text: text after NAME=, as typed.
        choices: values as text; () for a range.
        low, high: ends of a range, both included.
        logarithmic: whether a range is uniform in the logarithm.
        count: number of points of a range on a grid; None if unspecified.
        integer: whether a range contains only integers.
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
        """Return the value at a position in [0, 1) of the axis. Choices, and the integers of a linear range, have equal shares."""
        if self.choices:
            return self.choices[min(int(share * len(self.choices)), len(self.choices) - 1)]
        low, high = (self.low - 0.5, self.high + 0.5) if self.integer else (self.low, self.high)
        return self.typed(self._between(max(low, 0.5) if self.integer and self.logarithmic else low, high, share))

    def typed(self, number: float) -> str:
        """Return a number of the range as text: rounded to an integer or four digits, and clamped to the ends."""
        if self.integer:
            return str(int(min(max(round(number), self.low), self.high)))
        return repr(min(max(float(f"{number:.{_DIGITS}g}"), self.low), self.high))

    def points(self) -> tuple[str, ...]:
        """Return the values on a grid, without repetition. Raises `InputError` for a range without a number of points."""
        if self.choices:
            return self.choices
        if self.count is None:
            if not self.integer or self.logarithmic or self.high - self.low >= _MOST_POINTS:
                raise InputError(
                    f"--over {self.name}={self.text}: on a grid, a range needs a number of points ({self.text}:5)"
                )
            return tuple(str(n) for n in range(int(self.low), int(self.high) + 1))
        ends = max(self.count - 1, 1)
        values = [self.typed(self._between(self.low, self.high, i / ends)) for i in range(self.count)]
        return tuple(dict.fromkeys(values))

    def _between(self, low: float, high: float, share: float) -> float:
        if self.logarithmic:
            return math.exp(math.log(low) + share * (math.log(high) - math.log(low)))
        return low + share * (high - low)


def parse_axes(
    texts: Iterable[str] | Mapping[str, str | Sequence[Any]], method: Method, fixed: Iterable[str] = ()
) -> tuple[Axis, ...]:
    """Return the axes of a sweep.

    Args:
        texts: `NAME=VALUE,VALUE` and `NAME=LOW:HIGH[:log][:POINTS]`; or, by name, the text after `NAME=` or a list of values.
        method: the method of the options; it must accept every value.
        fixed: options that are set already.

    Raises:
        InputError: no axis, a malformed or repeated axis, an option that is fixed already, or one that the method does not have.
    """
    axes = []
    taken = set(fixed)
    for name, values in (texts if isinstance(texts, Mapping) else _by_name(texts)).items():
        if name in taken:
            raise InputError(f"--over {name}: it is fixed by --set")
        if isinstance(values, str):
            axes.append(_range(name, values, method) or _choices(name, values, _split(values), method))
        else:
            listed = [as_text(value) for value in values]
            axes.append(_choices(name, ",".join(listed), listed, method))
    if not axes:
        raise InputError("sweep: nothing to vary; give --over NAME=VALUE,VALUE or --over NAME=LOW:HIGH")
    return tuple(axes)


def as_text(value: Any) -> str:
    """Return a value of an option as text, as in sweep.json and on the command line."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _by_name(texts: Iterable[str]) -> dict[str, str]:
    values_of: dict[str, str] = {}
    for text in texts:
        name, equals, values = (part.strip() for part in text.partition("="))
        if not (equals and name and values):
            raise InputError(f"--over {text}: expected NAME=VALUE,VALUE or NAME=LOW:HIGH[:log][:POINTS]")
        if name in values_of:
            raise InputError(f"--over {text}: {name} is given twice")
        values_of[name] = values
    return values_of


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
    """Split the text at commas outside of parentheses: "cosine(300),steps(100, 0.5)" has two parts."""
    parts, depth = [""], 0
    for character in values:
        depth += (character == "(") - (character == ")")
        if character == "," and depth <= 0:
            parts.append("")
        else:
            parts[-1] += character
    return parts


def _range(name: str, values: str, method: Method) -> Axis | None:
    """Return the range of the text; None if it does not begin with two numbers separated by a colon."""
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
    integer = _is_integer(name, method)
    for end in (low, high):
        if integer and end != int(end):
            raise InputError(f"{where}: expected whole numbers, got {end:g}")
        method.configure({name: int(end) if integer else end})
    return Axis(name, values, (), low, high, logarithmic, count, integer)


def _is_integer(name: str, method: Method) -> bool:
    """Return whether the option accepts integers only. Raises `InputError` for an option that is unknown or not a number."""
    if name not in method.options.model_fields:
        method.configure({name: 0})  # says so
    words = method.expected(name)
    if "a number" not in words and "a whole number" not in words:
        raise InputError(f"--over {name}: a range needs an option that is a number, {name} is {words}")
    return "a number" not in words


_MOST_TRIALS = 100_000


class Search(ABC):
    """A search that proposes settings by number. `ask` and `tell` are called in ascending order of the numbers, once for each."""

    trials: int
    """Number of trials."""
    learns: ClassVar[bool] = False
    """Whether proposals depend on the outcomes of earlier trials."""

    @abstractmethod
    def ask(self, number: int) -> dict[str, str]:
        """Return {option: value as text} of a trial."""

    def tell(self, number: int, error: float | None) -> None:  # noqa: B027 (only a search that learns has to listen)
        """Report the error to minimise of a trial that `ask` proposed; None for a failed one."""


@dataclass(frozen=True)
class Grid(Search):
    """All combinations of the points of the axes; the last axis varies fastest.

    Raises `InputError` for a range without a number of points, or more combinations than 100 000.
    """

    axes: Sequence[Axis]

    def __post_init__(self) -> None:
        if self.trials > _MOST_TRIALS:
            raise InputError(f"sweep: the grid has {self.trials} points, expected at most {_MOST_TRIALS}")

    @property
    def trials(self) -> int:
        return math.prod(len(axis.points()) for axis in self.axes)

    def ask(self, number: int) -> dict[str, str]:
        values: dict[str, str] = {}
        for axis in reversed(self.axes):
            points = axis.points()
            number, index = divmod(number, len(points))
            values[axis.name] = points[index]
        return {axis.name: values[axis.name] for axis in self.axes}


@dataclass(frozen=True)
class Random(Search):
    """Independent random settings, each a function of the seed and the number: a longer sweep begins with the trials of a shorter one."""

    axes: Sequence[Axis]
    trials: int
    seed: int = 0

    def ask(self, number: int) -> dict[str, str]:
        key = Key(self.seed, number)
        return {axis.name: axis.at(key.fold(i).uint32() / 2**32) for i, axis in enumerate(self.axes)}


@dataclass
class TPE(Search):
    """The tree-structured Parzen estimator, which proposes settings that are likely to be good after the earlier trials.

    The settings of a trial are a function of the axes, of the seed and of the outcomes reported before. The same sequence of calls
    gives the same trials, with one version of Optuna. Trials in progress count as bad, so that their settings are not proposed again.
    Raises `InputError` if Optuna is not installed.
    """

    axes: Sequence[Axis]
    trials: int
    seed: int = 0
    _study: Any = field(init=False, repr=False)
    _asked: dict[int, Any] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                import optuna
        except ImportError as error:
            raise InputError(f"--search tpe needs Optuna ({error}): pip install 'unrender[sweep]'") from error
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of experimental features
            sampler = optuna.samplers.TPESampler(seed=self.seed % 2**32, constant_liar=True, multivariate=True)
            self._study = optuna.create_study(sampler=sampler)

    learns = True

    def ask(self, number: int) -> dict[str, str]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trial = self._study.ask(_distributions(self.axes))
        self._asked[number] = trial
        proposed = [(axis, trial.params[axis.name]) for axis in self.axes]
        return {axis.name: value if axis.choices else axis.typed(value) for axis, value in proposed}

    def tell(self, number: int, error: float | None) -> None:
        from optuna.trial import TrialState

        self._study.tell(self._asked.pop(number), error, TrialState.FAIL if error is None else TrialState.COMPLETE)


def _distributions(axes: Sequence[Axis]) -> dict[str, Any]:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    distributions: dict[str, Any] = {}
    for axis in axes:
        if axis.choices:
            distributions[axis.name] = CategoricalDistribution(axis.choices)
        elif axis.integer:
            distributions[axis.name] = IntDistribution(int(axis.low), int(axis.high), log=axis.logarithmic)
        else:
            distributions[axis.name] = FloatDistribution(axis.low, axis.high, log=axis.logarithmic)
    return distributions
