"""sweep.json: the plan of a sweep and its results so far; its run folders, and the order in which trials start."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StrictBool, StrictInt, StrictStr

from unrender.core.errors import InputError
from unrender.io import bounded_files, files
from unrender.runs.folder import schema
from unrender.statistics import debiased

if TYPE_CHECKING:
    from unrender.app.sweeps.search import Search
    from unrender.runs.folder.reader import RunFolder
    from unrender.scene.problem import Problem

SWEEP = "sweep.json"
_Count = Annotated[StrictInt, Field(ge=0, lt=2**63)]
_Positive = Annotated[StrictInt, Field(ge=1, lt=2**31)]
_Name = Annotated[StrictStr, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,79}$")]
_Text = Annotated[StrictStr, Field(max_length=4096)]


class SweepPlan(BaseModel):
    """The plan of a sweep: sweeps with equal plans have equal trials.

    Attributes:
        problem, problem_settings: the problem and its settings, as typed.
        method, settings: the method and the settings that all trials share.
        trials: number of trials; None for all points of a grid.
        seed, seeds: seed of the first run of each trial and of the search; number of runs of a trial, with consecutive seeds.
        steps, seconds: the budget of each run.
        window: the window of a search that learns, see `Trials`; None before it is chosen.
        final_spp, variant: see `unrender run`.
        cached: whether references may come from the cache.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    problem: _Text
    problem_settings: dict[_Text, _Text] = {}
    method: _Text
    settings: dict[_Text, _Text] = {}
    over: list[_Text]
    search: Literal["grid", "random", "tpe"]
    trials: Annotated[StrictInt, Field(ge=1, le=100_000)] | None = None
    seed: _Count = 0
    seeds: Annotated[StrictInt, Field(ge=1, le=10_000)] = 1
    steps: _Positive | None = None
    seconds: Annotated[FiniteFloat, Field(gt=0)] | None = None
    window: _Positive | None = None
    final_spp: _Positive | None = None
    variant: _Text = "auto"
    cached: StrictBool = True


class RunOutcome(BaseModel):
    """The outcome of one run of a trial.

    Attributes:
        folder: its run folder, within the folder of the sweep.
        status: the status in the run folder at the end of the run.
        stopped: see `Result.stopped`.
        error, standard_error: see `stated_error`; None if unknown.
        steps, samples, seconds: its work; the seconds are those of the optimisation.
        wall_seconds: duration including compilation and pictures; 0 for a run that existed before the session.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    folder: _Name
    seed: _Count
    status: Literal["finished", "worse than start", "memory disagrees", "does not fit", "failed", "interrupted"]
    stopped: StrictStr = ""
    error: FiniteFloat | None = None
    standard_error: FiniteFloat | None = None
    steps: _Count = 0
    samples: _Count = 0
    seconds: FiniteFloat = 0.0
    wall_seconds: FiniteFloat = 0.0
    message: _Text = ""


class TrialRecord(BaseModel):
    """One trial that has ended.

    Attributes:
        number: index of the trial, from 0.
        settings: values of the axes.
        error: mean over its runs; None for a failed trial.
        standard_error: standard error of the mean, from the spread over runs, or that of a single run; None if unknown.
        runs: its runs, in order of their seeds; fewer than planned in a failed trial.
        attempts: number of attempts: more than one if workers died.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    number: _Count
    settings: dict[_Text, _Text]
    status: Literal["finished", "failed"]
    error: FiniteFloat | None = None
    standard_error: FiniteFloat | None = None
    runs: list[RunOutcome] = []
    attempts: _Count = 1
    message: _Text = ""

    @property
    def line(self) -> str:
        """The settings, as options of `unrender run`."""
        from shlex import quote

        return " ".join(f"-s {quote(f'{name}={value}')}" for name, value in self.settings.items())


class SweepRecord(BaseModel):
    """The content of sweep.json.

    Attributes:
        status: "running", "finished" or "interrupted".
        definition: {part of the problem: its text or hash} when the first trial started; empty in sweeps of earlier versions.
        best: number of the finished trial with the least error; None before a trial has finished.
        best_line: the settings of that trial, as they are typed; "" before a trial has finished.
        wall_seconds: duration of all sessions so far.
        trials: the trials that have ended, in ascending order.
    """

    model_config = ConfigDict(extra="ignore")

    format: Literal[1] = 1
    status: Literal["running", "finished", "interrupted"] = "running"
    command: StrictStr = ""
    plan: SweepPlan
    definition: dict[_Text, _Text] = {}
    best: _Count | None = None
    best_line: StrictStr = ""
    wall_seconds: FiniteFloat = 0.0
    trials: list[TrialRecord] = []


def read_sweep(folder: Path) -> SweepRecord:
    """Return the record in the folder of a sweep. Raises `InputError` if no record exists, or it is malformed."""
    if bounded_files.kind(folder / SWEEP) != "file":
        raise InputError(f"{folder}: holds no sweep ({SWEEP} is missing)")
    content = bounded_files.read_object(folder / SWEEP, folder)
    try:
        record = schema.validate(SweepRecord, content, str(folder / SWEEP))
    except InputError as error:
        raise InputError(f"{error}; start the sweep again if another version of unrender made it") from error
    numbers = [trial.number for trial in record.trials]
    if numbers != sorted(set(numbers)):
        raise InputError(f"{folder / SWEEP}: trials: expected ascending numbers, each once")
    return record


def write_sweep(folder: Path, record: SweepRecord) -> None:
    """Write sweep.json to a temporary file and rename it. Raises `InputError` if the file cannot be written."""
    files.write(folder / SWEEP, schema.encode(SweepRecord, record.model_dump(), str(folder / SWEEP)))


RUN_FOLDERS = "trial-*-seed*"
_MOST_WATCHED = 64


def run_name(trial: int, seed: int) -> str:
    """Return the name of a run folder within the folder of its sweep."""
    return f"trial-{trial:03d}-seed{seed}"


def best_folders(folder: Path, record: SweepRecord, most: int = 1) -> list[Path]:
    """Return the run folders of the `most` finished trials with the least error, the best trial first."""
    known = [(trial.error, trial) for trial in record.trials if trial.status == "finished" and trial.error is not None]
    ordered = sorted(known, key=lambda entry: (entry[0], entry[1].number))[:most]
    return [folder / run.folder for _, trial in ordered for run in trial.runs]


def watched_folders(folder: Path) -> list[Path]:
    """Return the run folders of a sweep to watch, also future ones, up to `_MOST_WATCHED`; else the folder itself."""
    if not (folder / SWEEP).is_file():
        return [folder]
    try:
        record = read_sweep(folder)
    except InputError:
        return [folder]
    plan = record.plan
    numbers = range(min(plan.trials or len(record.trials) or 1, _MOST_WATCHED))
    run_folders = [
        folder / run_name(number, plan.seed + i) for number in numbers for i in range(min(plan.seeds, _MOST_WATCHED))
    ]
    return run_folders[:_MOST_WATCHED]


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
    """A trial to start: its index, and {option: value as text}."""

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
    stopped = not runs or any(run.status == "failed" for run in runs)
    unknown = "" if stopped or len(errors) == len(runs) else "no truth and no error of final pictures is known"
    if message or stopped or unknown:
        return TrialRecord(
            number=number,
            settings=settings,
            status="failed",
            runs=list(runs),
            attempts=attempts,
            message=message or unknown or "a run was stopped: its gradients were not finite",
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
