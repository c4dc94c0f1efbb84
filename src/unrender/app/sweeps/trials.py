"""The schedule of a sweep: which trial starts next, and the limits of its runs."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

from unrender.app.sweeps import pruning
from unrender.app.sweeps.record import RunOutcome, TrialRecord
from unrender.app.sweeps.search import Search, TrialOutcome
from unrender.core.errors import InputError


@dataclass(frozen=True)
class Started:
    """A trial to start.

    Attributes:
        number: index of the trial, from 0.
        settings: {option: value as text}.
        limits: limits of the pruning of its first run, see `pruning.is_hopeless`; {} disables pruning.
    """

    number: int
    settings: dict[str, str]
    limits: dict[float, float]


@dataclass
class Trials:
    """A schedule that starts trials in ascending order.

    If trials depend on earlier ones (a search that learns, or pruning), trial i depends on trials 0 to i - window only. It starts after
    these have ended. Therefore the results of the sweep are the same for any number of workers.

    Attributes:
        search: the search that proposes settings.
        prune: whether runs are stopped early.
        window: limit of the trials in progress if they depend on earlier ones, >= 1.
        ended: {number: record of the trial}.
    """

    search: Search
    prune: bool = False
    window: int = 4
    ended: dict[int, TrialRecord] = field(default_factory=dict)
    _asked: int = 0
    _reported: int = 0

    @property
    def dependent(self) -> bool:
        """True if trials depend on earlier ones."""
        return self.prune or self.search.learns

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
            while self.dependent and self._reported <= number - self.window:
                if self._reported not in self.ended:
                    return None
                self._tell(self._reported)
                self._reported += 1
            settings = self.search.ask(number)
            self._asked += 1
            if number not in self.ended:
                return Started(number, settings, self._limits(number))
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

    def _tell(self, number: int) -> None:
        trial = self.ended[number]
        self.search.tell(number, TrialOutcome(trial.status, trial.error, _rungs(trial)))

    def _limits(self, number: int) -> dict[float, float]:
        if not self.prune:
            return {}
        visible = [self.ended[i] for i in range(number - self.window + 1) if i in self.ended]
        return pruning.medians(
            {**_rungs(trial), 1.0: run.error}
            for trial in visible
            for run in trial.runs[:1]
            if trial.status == "finished" and run.error is not None
        )


def trial_record(
    number: int, settings: dict[str, str], runs: Sequence[RunOutcome], attempts: int = 1, message: str = ""
) -> TrialRecord:
    """Return the record of a trial from the outcomes of its runs; `message` is the error of the trial as a unit."""
    message = message or next((run.message for run in runs if run.message), "")
    errors = [run.error for run in runs if run.error is not None]
    status = "finished"
    if message or not runs or len(errors) < len(runs) or any(run.status == "failed" for run in runs):
        return TrialRecord(
            number=number,
            settings=settings,
            status="failed",
            runs=list(runs),
            attempts=attempts,
            message=message or "a run was stopped: its gradients were not finite",
        )
    if any(run.status == "pruned" for run in runs):
        status = "pruned"
    spread = statistics.stdev(errors) / math.sqrt(len(errors)) if len(errors) > 1 else runs[0].standard_error
    return TrialRecord(
        number=number,
        settings=settings,
        status=status,
        error=statistics.fmean(errors),
        standard_error=spread,
        runs=list(runs),
        attempts=attempts,
    )


def _rungs(trial: TrialRecord) -> dict[float, float]:
    """Return the errors during the first run of the trial, the only one that is pruned."""
    return {float(share): error for share, error in trial.runs[0].rungs.items()} if trial.runs else {}
