"""Tree-structured Parzen estimators (Bergstra et al. 2011), by Optuna."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from unrender.app.sweeps.axes import Axis
from unrender.app.sweeps.search import TrialOutcome
from unrender.core.errors import InputError

__all__ = ["TPE"]


@dataclass
class TPE:
    """Settings that earlier trials make likely to be good.

    A trial's settings are a function of the axes, the seed and what was told before it was asked for: the same sequence of calls gives the
    same trials, with one version of Optuna. Those under way count as bad ones, so that they are not proposed again.

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
            warnings.simplefilter("ignore")  # what is experimental there
            sampler = optuna.samplers.TPESampler(seed=self.seed % 2**32, constant_liar=True, multivariate=True)
            self._study = optuna.create_study(sampler=sampler)

    @property
    def learns(self) -> bool:
        """See `Search.learns`."""
        return True

    def ask(self, number: int) -> dict[str, str]:
        """See `Search.ask`."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trial = self._study.ask(_distributions(self.axes))
        self._asked[number] = trial
        return {axis.name: _text(axis, trial.params[axis.name]) for axis in self.axes}

    def tell(self, number: int, outcome: TrialOutcome) -> None:
        """See `Search.tell`."""
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

    found: dict[str, Any] = {}
    for axis in axes:
        if axis.choices:
            found[axis.name] = CategoricalDistribution(axis.choices)
        elif axis.integer:
            found[axis.name] = IntDistribution(int(axis.low), int(axis.high), log=axis.logarithmic)
        else:
            found[axis.name] = FloatDistribution(axis.low, axis.high, log=axis.logarithmic)
    return found
