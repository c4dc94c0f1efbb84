"""The order of a sweep: which trial may begin, by what it is judged, and what is known when."""

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
    """A trial that may begin.

    Attributes:
        number: from 0.
        settings: {option: value as text}.
        limits: by which its first run is pruned, see `pruning.is_hopeless`; {} prunes none.
    """

    number: int
    settings: dict[str, str]
    limits: dict[float, float]


@dataclass
class Trials:
    """Hands out trials in ascending order.

    Where trials depend on earlier ones, by a search that learns or by pruning, trial i depends on trials 0 to i - window alone, whatever
    else has ended by then, and begins once these have: so the sweep's outcome is the same for any number of workers.

    Attributes:
        search: what proposes settings.
        prune: whether runs are given up.
        window: how many trials may be under way at once where they depend on earlier ones, >= 1.
        ended: {number: what became of it}.
    """

    search: Search
    prune: bool = False
    window: int = 4
    ended: dict[int, TrialRecord] = field(default_factory=dict)
    _asked: int = 0
    _told: int = 0

    @property
    def dependent(self) -> bool:
        """Whether trials depend on earlier ones."""
        return self.prune or self.search.learns

    @property
    def done(self) -> bool:
        """Whether all trials have ended."""
        return len(self.ended) >= self.search.trials

    def next(self) -> Started | None:
        """A trial to begin now; None where none may yet, or none is left. Those that have ended already are passed over."""
        while self._asked < self.search.trials:
            number = self._asked
            while self.dependent and self._told <= number - self.window:
                if self._told not in self.ended:
                    return None
                self._tell(self._told)
                self._told += 1
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
        """Note what became of a trial."""
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
    """What became of a trial whose runs ended so; `message`: why it failed as a whole."""
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
            message=message or "a run was given up: its gradients were not finite",
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
    """The errors on the way of the trial's first run: it alone is pruned."""
    return {float(share): error for share, error in trial.runs[0].rungs.items()} if trial.runs else {}
