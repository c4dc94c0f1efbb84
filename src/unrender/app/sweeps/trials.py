"""The schedule of a sweep: which trial starts next, and which runs end early.

Runs end by the median rule (Golovin et al. 2017) if their error exceeds the median of earlier trials at the same fraction of the budget,
unless it falls fast enough to end below the final median."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.app.sweeps.record import RunOutcome, TrialRecord
from unrender.app.sweeps.search import Search, TrialOutcome
from unrender.core.errors import InputError
from unrender.io import bounded_files, files
from unrender.runs.callbacks import Callback
from unrender.runs.folder.reader import RunFolder
from unrender.runs.result import PRUNED
from unrender.scene.problem import Problem
from unrender.scene.render import render
from unrender.statistics import debiased

if TYPE_CHECKING:
    from unrender.runs.run import Run

RUNGS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8)
"""Fractions of the budget at which the error of a run is measured; no run is pruned at the first one."""
RUNG_FILE = "rungs.json"
_FEWEST = 4
"""Minimum number of finished trials with an error at a fraction before a run is pruned there."""
_PATHS, _MOST_SPP = 1 << 19, 64
_SEED = 1 << 20
"""Seed of the pictures during a run; it differs from the seeds of the final pictures."""


def medians(finished: Iterable[Mapping[float, float]]) -> dict[float, float]:
    """Return {fraction: median error} of finished trials; a fraction with fewer than four errors is left out.

    Args:
        finished: {fraction: error} of each finished trial; its final error has the fraction 1.
    """
    trials = list(finished)
    median_errors = {}
    for share in (*RUNGS, 1.0):
        values = [errors[share] for errors in trials if share in errors]
        if len(values) >= _FEWEST:
            median_errors[share] = statistics.median(values)
    return median_errors


def is_hopeless(errors: Mapping[float, float], limits: Mapping[float, float]) -> bool:
    """Return whether to stop a run: its last error exceeds the median there, and its predicted final error exceeds the final median.

    The prediction assumes that the error continues to fall by the factor per fraction of the budget between its last two measurements.
    The second condition spares runs that converge slowly at first and end best, as small learning rates do.

    Args:
        errors: {fraction: error} of the run so far.
        limits: `medians` of other trials.
    """
    if len(errors) < 2:
        return False
    before, now = sorted(errors)[-2:]
    if errors[now] <= limits.get(now, math.inf):
        return False
    if not 0 < errors[now] < errors[before]:
        return errors[now] > limits.get(1.0, 0.0)
    pace = (math.log(errors[now]) - math.log(errors[before])) / (now - before)
    return math.log(errors[now]) + pace * (1 - now) > math.log(max(limits.get(1.0, 0.0), 1e-300))


def stated_error(run: RunFolder, start: Mapping[str, float]) -> tuple[float, float | None]:
    """Return the error that a sweep minimises, and its standard error if it has one.

    Parameters with a known truth have the error of their measure (`run.measure`), such as root mean square. With several of them, it is the
    mean of the ratios to the errors `start` of the problem's initial values, since methods may start elsewhere. Without truth, it is the
    debiased root mean square error of the final pictures, the mean over views. Raises `InputError` if neither the truth nor an error of
    pictures is known.
    """
    if run.error_after:
        return _combined(run.error_after, start), None
    image_errors = [error for name, error in run.record.image_errors.items() if name.endswith("/result")]
    if not image_errors:
        raise InputError(f"run folder {run.path}: neither the truth nor an error of final pictures is known")
    return debiased.mean(image_errors)


class Pruning(Callback):
    """A callback that measures the error of a run at `RUNGS`, writes it to rungs.json, and ends the run if it `is_hopeless`.

    The error is that of `stated_error`, of parameters if the truth is known, otherwise of pictures with few samples. In both cases it
    is a function of the run alone.

    Args:
        limits: `medians` of other trials; {} ends no run.
    """

    def __init__(self, folder: Path, limits: Mapping[float, float]):
        self._path = folder / RUNG_FILE
        self._limits = dict(limits)
        self._errors: dict[float, float] = {}
        self._initial: dict[str, float] = {}

    def on_start(self, run: Run) -> None:
        problem = run.problem
        self._initial = initial_errors(problem)
        self._errors = {}
        if run.step:  # resumed
            self._errors = {share: error for share, error in read_rungs(self._path).items() if share <= run.progress()}
        else:
            self._path.unlink(missing_ok=True)

    def on_step(self, run: Run, record: dict[str, Any]) -> None:
        passed = [share for share in RUNGS if max(self._errors, default=0.0) < share <= run.progress()]
        if not passed or run.stopped:
            return
        if run.problem.has_truth:
            error = _combined(run.problem.parameter_error(run.parameters), self._initial)
        else:
            error = _picture_error(run.problem, run.full())
        # The greatest number in place of infinity or NaN can be compared and written.
        self._errors[passed[-1]] = error if math.isfinite(error) else float(np.finfo(np.float64).max)
        if is_hopeless(self._errors, self._limits):
            run.stop(PRUNED)
        text = json.dumps({str(share): value for share, value in self._errors.items()}) + "\n"
        files.write(self._path, text.encode(), durable=False)


def read_rungs(path: Path) -> dict[float, float]:
    """Return {fraction: error} of a file of `Pruning`; {} if the file is missing or malformed."""
    try:
        content = bounded_files.parse_json(bounded_files.read_bytes(path, 1 << 12), str(path))
    except (InputError, OSError):
        return {}
    errors = {}
    for name, value in content.items() if isinstance(content, dict) else ():
        share = next((share for share in RUNGS if str(share) == name), None)
        if share is not None and isinstance(value, (int, float)) and not isinstance(value, bool):
            errors[share] = float(value)
    return errors


def initial_errors(problem: Problem) -> dict[str, float]:
    """Return the errors of the initial values of the problem, see `Problem.parameter_error`."""
    return problem.parameter_error(problem.initial()) if problem.has_truth else {}


def _combined(errors: Mapping[str, float], initial: Mapping[str, float]) -> float:
    """Return the error of a single parameter; with several, the mean of the errors relative to the initial ones."""
    if len(errors) == 1:
        return next(iter(errors.values()))
    return float(np.mean([error / (initial.get(key) or 1.0) for key, error in errors.items()]))


def _picture_error(problem: Problem, values: Mapping[str, np.ndarray]) -> float:
    pixels = problem.pixels
    spp = min(max(_PATHS // max(pixels, 1), 1), _MOST_SPP)
    errors = []
    for index, view in enumerate(problem.views):
        one, other = (render(problem, values, index, spp, _SEED + half) for half in (0, 1))
        errors.append(debiased.rmse(one, other, np.asarray(view.reference), problem.test_weights(index, (one, other))))
    return debiased.mean(errors)[0]


@dataclass(frozen=True)
class Started:
    """A trial to start.

    Attributes:
        number: index of the trial, from 0.
        settings: {option: value as text}.
        limits: limits of the pruning of its first run, see `is_hopeless`; {} disables pruning.
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
                trial = self.ended[self._reported]
                self.search.tell(trial.number, TrialOutcome(trial.status, trial.error, _rungs(trial)))
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

    def _limits(self, number: int) -> dict[float, float]:
        if not self.prune:
            return {}
        visible = [self.ended[i] for i in range(number - self.window + 1) if i in self.ended]
        return medians(
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
