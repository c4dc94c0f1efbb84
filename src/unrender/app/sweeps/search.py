"""Which settings a sweep tries: all of a grid, random ones, or those that a model of the earlier ones proposes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from unrender.app.sweeps.axes import Axis
from unrender.core.errors import InputError
from unrender.core.random import Key

__all__ = ["Grid", "Random", "Search", "TrialOutcome"]

_MOST_TRIALS = 100_000


@dataclass(frozen=True)
class TrialOutcome:
    """What became of a trial.

    Attributes:
        status: "finished", "pruned" or "failed".
        error: what is to be small; None for a trial that failed.
        rungs: {share of the budget: error} on the way.
    """

    status: str
    error: float | None
    rungs: dict[float, float]


class Search(Protocol):
    """Proposes settings by number. Trials are asked for, and told of, in ascending order, each once."""

    @property
    def trials(self) -> int:
        """How many there are to be."""
        ...

    @property
    def learns(self) -> bool:
        """Whether settings depend on what was told."""
        ...

    def ask(self, number: int) -> dict[str, str]:
        """{option: value as text} of a trial."""
        ...

    def tell(self, number: int, outcome: TrialOutcome) -> None:
        """What became of one that was asked for."""
        ...


@dataclass(frozen=True)
class Grid:
    """Every combination of the axes' points, the last axis fastest.

    Raises:
        InputError: a range without a number of points, or more combinations than 100 000.
    """

    axes: Sequence[Axis]

    def __post_init__(self) -> None:
        if self.trials > _MOST_TRIALS:
            raise InputError(f"sweep: the grid has {self.trials} points, expected at most {_MOST_TRIALS}")

    @property
    def trials(self) -> int:
        """See `Search.trials`."""
        return math.prod(len(axis.points()) for axis in self.axes)

    @property
    def learns(self) -> bool:
        """See `Search.learns`."""
        return False

    def ask(self, number: int) -> dict[str, str]:
        """See `Search.ask`."""
        found: dict[str, str] = {}
        for axis in reversed(self.axes):
            points = axis.points()
            number, index = divmod(number, len(points))
            found[axis.name] = points[index]
        return {axis.name: found[axis.name] for axis in self.axes}

    def tell(self, number: int, outcome: TrialOutcome) -> None:
        """See `Search.tell`."""


@dataclass(frozen=True)
class Random:
    """Independent settings, each a function of the seed and the number: a longer sweep begins with the trials of a shorter one."""

    axes: Sequence[Axis]
    trials: int
    seed: int = 0

    @property
    def learns(self) -> bool:
        """See `Search.learns`."""
        return False

    def ask(self, number: int) -> dict[str, str]:
        """See `Search.ask`."""
        key = Key(self.seed, number)
        return {axis.name: axis.at(key.fold(i).uint32() / 2**32) for i, axis in enumerate(self.axes)}

    def tell(self, number: int, outcome: TrialOutcome) -> None:
        """See `Search.tell`."""
