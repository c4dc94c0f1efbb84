"""sweep.json: what a sweep tries, and what it has found so far."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StrictBool, StrictInt, StrictStr

from unrender.core.errors import InputError
from unrender.io import bounded_files, files
from unrender.runs.folder import schema

SWEEP = "sweep.json"
_Count = Annotated[StrictInt, Field(ge=0, lt=2**63)]
_Positive = Annotated[StrictInt, Field(ge=1, lt=2**31)]
_Name = Annotated[StrictStr, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,79}$")]
_Text = Annotated[StrictStr, Field(max_length=4096)]


class SweepPlan(BaseModel):
    """What a sweep is: two with equal plans have equal trials.

    Attributes:
        problem, problem_settings: as typed.
        method, settings: of all trials.
        over: the axes, as typed.
        search: how trials are chosen.
        trials: how many; None on a grid, for all of it.
        seed, seeds: of the first run of each trial and of the search; how many runs a trial has, of one seed after the other.
        steps, seconds: the budget of each run.
        prune: whether runs above the median are given up.
        window: of sweeps whose trials depend on earlier ones, see `Trials`; None before it is chosen.
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
    prune: StrictBool = False
    window: _Positive | None = None
    final_spp: _Positive | None = None
    variant: _Text = "auto"
    cached: StrictBool = True


class RunOutcome(BaseModel):
    """One run of a trial.

    Attributes:
        folder: its run folder, within the sweep's.
        seed: of its random numbers.
        status: "pruned", or that of the run folder when its run ended.
        stopped: see `Result.stopped`.
        error, standard_error: see `pruning.stated_error`; None where they are not known.
        rungs: {share of the budget: error} on the way.
        steps, samples, seconds: that it took; seconds are of optimization.
        wall_seconds: from its beginning to its end, compilation and pictures included; 0 for a run that was there already.
        message: what went wrong; "" for nothing.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    folder: _Name
    seed: _Count
    status: Literal["finished", "worse than start", "memory disagrees", "pruned", "failed", "interrupted"]
    stopped: StrictStr = ""
    error: FiniteFloat | None = None
    standard_error: FiniteFloat | None = None
    rungs: dict[StrictStr, FiniteFloat] = {}
    steps: _Count = 0
    samples: _Count = 0
    seconds: FiniteFloat = 0.0
    wall_seconds: FiniteFloat = 0.0
    message: _Text = ""


class TrialRecord(BaseModel):
    """One trial that came to an end.

    Attributes:
        number: from 0.
        settings: of the method, those of the axes.
        status: "finished"; "pruned"; or "failed".
        error: the mean over its runs; None for one that failed.
        standard_error: of that mean: from the spread over runs, or the run's own; None where it is not known.
        runs: its runs, in order of their seeds; fewer than planned where it was pruned or failed.
        attempts: how often it was begun: more than once where workers died.
        message: what went wrong; "" for nothing.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    number: _Count
    settings: dict[_Text, _Text]
    status: Literal["finished", "pruned", "failed"]
    error: FiniteFloat | None = None
    standard_error: FiniteFloat | None = None
    runs: list[RunOutcome] = []
    attempts: _Count = 1
    message: _Text = ""

    @property
    def line(self) -> str:
        """Its settings as `unrender run` takes them."""
        from shlex import quote

        return " ".join(f"-s {quote(f'{name}={value}')}" for name, value in self.settings.items())


class SweepRecord(BaseModel):
    """sweep.json.

    Attributes:
        format: of the file.
        status: "running", "finished" or "interrupted".
        command: what was typed.
        plan: what the sweep is.
        best: the number of the finished trial of the least error; None before there is one.
        best_line: its settings, as they are typed; "" likewise.
        wall_seconds: of all sessions so far.
        trials: those that came to an end, in ascending order.
    """

    model_config = ConfigDict(extra="ignore")

    format: Literal[1] = 1
    status: Literal["running", "finished", "interrupted"] = "running"
    command: StrictStr = ""
    plan: SweepPlan
    best: _Count | None = None
    best_line: StrictStr = ""
    wall_seconds: FiniteFloat = 0.0
    trials: list[TrialRecord] = []


def read_sweep(folder: Path) -> SweepRecord:
    """The record of a sweep's folder. Raises `InputError` where there is none, or it is malformed."""
    if bounded_files.kind(folder / SWEEP) != "file":
        raise InputError(f"{folder}: holds no sweep ({SWEEP} is missing)")
    record = schema.validate(SweepRecord, bounded_files.read_object(folder / SWEEP, folder), str(folder / SWEEP))
    numbers = [trial.number for trial in record.trials]
    if numbers != sorted(set(numbers)):
        raise InputError(f"{folder / SWEEP}: trials: expected ascending numbers, each once")
    return record


def write_sweep(folder: Path, record: SweepRecord) -> None:
    """Write sweep.json beside its place, and rename it. Raises `InputError` where that cannot be."""
    data = schema.encode(SweepRecord, record.model_dump(), str(folder / SWEEP))
    try:
        files.write(folder / SWEEP, data)
    except OSError as error:
        raise InputError(f"sweep {folder}: cannot be written: {error.strerror or error}") from error
