"""The schedule of a sweep: which trial starts next; and the error of a run that a sweep minimises."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from unrender.app.sweeps.record import RunOutcome, TrialRecord
from unrender.app.sweeps.search import Search
from unrender.core.errors import InputError
from unrender.runs.folder.reader import RunFolder
from unrender.scene.problem import Problem
from unrender.statistics import debiased


def stated_error(run: RunFolder, start: Mapping[str, float]) -> tuple[float, float | None]:
    """Return the error that a sweep minimises, and its standard error if it has one.

    Parameters with a known truth have the error of their measure (`run.measure`), such as root mean square. With several of them, it is the
    mean of the ratios to the errors `start` of the problem's initial values, since methods may start elsewhere. Without truth, it is the
    debiased root mean square error of the final pictures, the mean over views. Raises `InputError` if neither the truth nor an error of
    pictures is known.
    """
    if run.error_after:
        if len(run.error_after) == 1:
            return next(iter(run.error_after.values())), None
        return float(np.mean([error / (start.get(key) or 1.0) for key, error in run.error_after.items()])), None
    image_errors = [error for name, error in run.record.image_errors.items() if name.endswith("/result")]
    if not image_errors:
        raise InputError(f"run folder {run.path}: neither the truth nor an error of final pictures is known")
    return debiased.mean(image_errors)


def initial_errors(problem: Problem) -> dict[str, float]:
    """Return the errors of the initial values of the problem, see `Problem.parameter_error`."""
    return problem.parameter_error(problem.initial()) if problem.has_truth else {}


@dataclass(frozen=True)
class Started:
    """A trial to start.

    Attributes:
        number: index of the trial, from 0.
        settings: {option: value as text}.
    """

    number: int
    settings: dict[str, str]


@dataclass
class Trials:
    """A schedule that starts trials in ascending order.

    If the search learns, trial i depends on trials 0 to i - window only. It starts after these have ended. Therefore the results of the
    sweep are the same for any number of workers.

    Attributes:
        search: the search that proposes settings.
        window: limit of the trials in progress if the search learns, >= 1.
        ended: {number: record of the trial}.
    """

    search: Search
    window: int = 4
    ended: dict[int, TrialRecord] = field(default_factory=dict)
    _asked: int = 0
    _reported: int = 0

    @property
    def done(self) -> bool:
        """True if all trials have ended."""
        return len(self.ended) >= self.search.trials

    def next(self) -> Started | None:
        """Return a trial to start now; None if none can start yet, or none is left. Trials that have ended already are skipped.

        Raises `InputError` if a trial that has ended had other settings than the search proposes now.
        """
        while self._asked < self.search.trials:
            number = self._asked
            while self.search.learns and self._reported <= number - self.window:
                if self._reported not in self.ended:
                    return None
                self.search.tell(self._reported, self.ended[self._reported].error)
                self._reported += 1
            settings = self.search.ask(number)
            self._asked += 1
            if number not in self.ended:
                return Started(number, settings)
            if self.ended[number].settings != settings:
                raise InputError(
                    f"sweep: trial {number} was made with {self.ended[number].line}, and would now be {settings}; "
                    "the versions differ with which it was begun: begin another sweep"
                )
        return None

    def end(self, record: TrialRecord) -> None:
        """Store the record of a trial that has ended."""
        self.ended[record.number] = record

    @property
    def best(self) -> TrialRecord | None:
        """The finished trial of the least error, the first one of equal ones."""
        finished = [t for _, t in sorted(self.ended.items()) if t.status == "finished" and t.error is not None]
        return min(finished, key=lambda trial: trial.error if trial.error is not None else math.inf, default=None)


def trial_record(
    number: int, settings: dict[str, str], runs: Sequence[RunOutcome], attempts: int = 1, message: str = ""
) -> TrialRecord:
    """Return the record of a trial from the outcomes of its runs; `message` is the error of the trial as a unit."""
    message = message or next((run.message for run in runs if run.message), "")
    errors = [run.error for run in runs if run.error is not None]
    if message or not runs or len(errors) < len(runs) or any(run.status == "failed" for run in runs):
        return TrialRecord(
            number=number,
            settings=settings,
            status="failed",
            runs=list(runs),
            attempts=attempts,
            message=message or "a run was stopped: its gradients were not finite",
        )
    spread = statistics.stdev(errors) / math.sqrt(len(errors)) if len(errors) > 1 else runs[0].standard_error
    return TrialRecord(
        number=number,
        settings=settings,
        status="finished",
        error=statistics.fmean(errors),
        standard_error=spread,
        runs=list(runs),
        attempts=attempts,
    )
