"""Search strategies of a sweep: all points of a grid, random settings, or proposals of a model of the earlier trials."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from unrender.app.sweeps.axes import Axis
from unrender.core.errors import InputError
from unrender.core.random import Key

_MOST_TRIALS = 100_000


@dataclass(frozen=True)
class TrialOutcome:
    """The outcome of a trial.

    Attributes:
        status: "finished", "pruned" or "failed".
        error: the error to minimise; None for a failed trial.
        rungs: {fraction of the budget: error} during the trial.
    """

    status: str
    error: float | None
    rungs: dict[float, float]


class Search(Protocol):
    """A search that proposes settings by number. `ask` and `tell` are called in ascending order of the numbers, once for each."""

    @property
    def trials(self) -> int:
        """The number of trials."""
        ...

    @property
    def learns(self) -> bool:
        """True if proposals depend on the outcomes of earlier trials."""
        ...

    def ask(self, number: int) -> dict[str, str]:
        """Return {option: value as text} of a trial."""
        ...

    def tell(self, number: int, outcome: TrialOutcome) -> None:
        """Report the outcome of a trial that `ask` proposed."""
        ...


@dataclass(frozen=True)
class Grid:
    """All combinations of the points of the axes; the last axis varies fastest.

    Raises:
        InputError: a range without a number of points, or more combinations than 100 000.
    """

    axes: Sequence[Axis]

    def __post_init__(self) -> None:
        if self.trials > _MOST_TRIALS:
            raise InputError(f"sweep: the grid has {self.trials} points, expected at most {_MOST_TRIALS}")

    @property
    def trials(self) -> int:
        return math.prod(len(axis.points()) for axis in self.axes)

    @property
    def learns(self) -> bool:
        return False

    def ask(self, number: int) -> dict[str, str]:
        values: dict[str, str] = {}
        for axis in reversed(self.axes):
            points = axis.points()
            number, index = divmod(number, len(points))
            values[axis.name] = points[index]
        return {axis.name: values[axis.name] for axis in self.axes}

    def tell(self, number: int, outcome: TrialOutcome) -> None:
        """Do nothing: the settings do not depend on outcomes."""


@dataclass(frozen=True)
class Random:
    """Independent random settings, each a function of the seed and the number: a longer sweep begins with the trials of a shorter one."""

    axes: Sequence[Axis]
    trials: int
    seed: int = 0

    @property
    def learns(self) -> bool:
        return False

    def ask(self, number: int) -> dict[str, str]:
        key = Key(self.seed, number)
        return {axis.name: axis.at(key.fold(i).uint32() / 2**32) for i, axis in enumerate(self.axes)}

    def tell(self, number: int, outcome: TrialOutcome) -> None:
        """Do nothing: the settings do not depend on outcomes."""


@dataclass
class TPE:
    """The tree-structured Parzen estimator, which proposes settings that are likely to be good after the earlier trials.

    The settings of a trial are a function of the axes, of the seed and of the outcomes reported before. The same sequence of calls
    gives the same trials, with one version of Optuna. Trials in progress count as bad, so that their settings are not proposed again.

    Raises:
        InputError: Optuna is not installed.
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

    @property
    def learns(self) -> bool:
        return True

    def ask(self, number: int) -> dict[str, str]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trial = self._study.ask(_distributions(self.axes))
        self._asked[number] = trial
        return {axis.name: _text(axis, trial.params[axis.name]) for axis in self.axes}

    def tell(self, number: int, outcome: TrialOutcome) -> None:
        from optuna.trial import TrialState

        trial = self._asked.pop(number)
        if outcome.error is None:
            self._study.tell(trial, state=TrialState.FAIL)
            return
        if outcome.status == "finished":
            self._study.tell(trial, outcome.error)
            return
        for share, error in outcome.rungs.items():
            trial.report(error, round(1000 * share))
        self._study.tell(trial, state=TrialState.PRUNED)


def _text(axis: Axis, value: Any) -> str:
    return value if axis.choices else axis.typed(value)


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
