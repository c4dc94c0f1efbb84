"""Runs of `compare` and `sweep` as tasks: their input, execution on a worker, and output."""

from __future__ import annotations

import contextlib
import functools
import io
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from unrender.app.cli import arguments
from unrender.app.cli.execute import RunOrder, execution
from unrender.app.distributed.cluster import prepare_worker
from unrender.app.sweeps.pruning import RUNG_FILE, Pruning, read_rungs, stated_error
from unrender.app.sweeps.record import RunOutcome
from unrender.core.errors import InputError
from unrender.display.terminal import Console
from unrender.io import files
from unrender.methods import method
from unrender.runs.callbacks import Callback
from unrender.runs.folder import reader
from unrender.runs.folder.lock import holder
from unrender.runs.folder.schema import CHECKPOINTS, ENDED, RECORD
from unrender.runs.live import Live
from unrender.runs.optimize import optimize
from unrender.runs.progress import Progress
from unrender.runs.result import PRUNED
from unrender.runs.resume import load_run, resume_run
from unrender.scene.problem import Problem

_PATIENCE_SECONDS = 30.0
"""Seconds to wait for a run folder that a dying process still locks."""
_MARK = ".unrender-folder"


@dataclass(frozen=True)
class Job:
    """Common data of all tasks of a command. It is serialisable.

    Attributes:
        problem, problem_settings, cached: see `arguments.open_problem`; a file's path is absolute.
        command: typed command.
        folder: output folder, an absolute path.
        token: contents of the file `.unrender-folder` in it: a worker that reads something else, or nothing, sends its results back.
        variant, threads: Mitsuba variant and processor threads of the workers.
    """

    problem: str
    problem_settings: Mapping[str, str]
    cached: bool
    command: str
    folder: str
    token: str = ""
    variant: str = "auto"
    threads: int = 1


@dataclass(frozen=True)
class RunTask:
    """One run. It is serialisable.

    Attributes:
        name: name of its run folder in the job's folder.
        method, settings: as typed.
        steps, seconds, seed, final_spp: see `RunOrder`.
        limits: see `Pruning`; None for a run whose intermediate errors are not evaluated.
    """

    name: str
    method: str
    settings: Mapping[str, str]
    steps: int | None
    seconds: float | None
    seed: int
    final_spp: int | None
    limits: Mapping[float, float] | None = None


def discard_earlier(folder: Path, tasks: Sequence[RunTask]) -> None:
    """Delete earlier runs in the folders of tasks, so that no task continues one."""
    for task in tasks:
        (folder / task.name / RECORD).unlink(missing_ok=True)


@contextlib.contextmanager
def open_job(job: Job) -> Iterator[None]:
    """Mark the job's folder, so that workers can detect whether they share it."""
    mark = Path(job.folder, _MARK)
    files.write(mark, job.token.encode(), durable=False)
    try:
        yield
    finally:
        mark.unlink(missing_ok=True)


def carry_out(
    job: Job, task: RunTask, problem: Problem, console: Console, progress: Progress, callbacks: Sequence[Callback] = ()
) -> RunOutcome:
    """Run a task, or continue its earlier attempt, and return its outcome. Raise `InputError` as `optimize` and `resume_run` do."""
    folder = Path(job.folder, task.name)
    _wait_until_free(folder)
    record = reader.read_run_record(folder) if (folder / RECORD).is_file() else None
    started = progress.budget_began = time.perf_counter()
    if record is None or record.status not in ENDED:
        looking = [] if task.limits is None else [Pruning(folder, task.limits)]
        listeners = [progress, *looking, *callbacks]
        if record is None or record.steps == 0 or not _resumed(folder, problem, listeners, record.command):
            chosen = method(task.method)
            order = RunOrder(
                chosen, task.settings, task.steps, task.seconds, task.seed, task.final_spp, job.command,
                job.problem_settings,
            )  # fmt: skip
            with execution(problem, order, folder, console, progress, listeners[1:]) as arguments_of_run:
                optimize(**arguments_of_run)
        return outcome(folder, task, time.perf_counter() - started)
    return outcome(folder, task, 0.0)


def outcome(folder: Path, task: RunTask, wall_seconds: float) -> RunOutcome:
    """Return the outcome of a run from its folder. Raise `InputError`."""
    run = reader.read(folder)
    record = run.record
    rungs = read_rungs(folder / RUNG_FILE)
    error: float | None
    standard_error: float | None
    status = "pruned" if record.stopped == PRUNED else record.status
    if status == "pruned" and rungs:
        error, standard_error = rungs[max(rungs)], None
    else:
        try:
            error, standard_error = stated_error(run)
        except InputError:
            error = standard_error = None
    return RunOutcome(
        folder=task.name,
        seed=task.seed,
        status="failed" if status == "running" else status,
        stopped=record.stopped,
        error=_finite(error),
        standard_error=_finite(standard_error),
        rungs={str(share): value for share, value in rungs.items()},
        steps=record.steps,
        samples=int(run.history.samples[-1]) if len(run.history) else 0,
        seconds=record.seconds,
        wall_seconds=wall_seconds,
    )


def quiet() -> tuple[Console, Progress]:
    """Return a console without visible output, and a progress listener that prints there."""
    console = Console(file=io.StringIO(), force_terminal=False)
    return console, Progress(console)


# ---------------------------------------------------------------------- worker


def on_worker(job: Job, tasks: Sequence[RunTask]) -> tuple[list[RunOutcome], dict[str, bytes]]:
    """Run tasks in turn, until one does not complete.

    Returns:
        Their outcomes; and, if the job's folder is not shared, {path within it: contents} of the written files.
    """
    prepare_worker(job.variant, job.threads)
    problem = _problem(job.problem, tuple(job.problem_settings.items()), job.cached)
    mark = Path(job.folder, _MARK)
    if mark.is_file() and mark.read_text("utf-8", errors="replace") == job.token:
        return in_turn(job, tasks, problem), {}
    place = Path(tempfile.mkdtemp(prefix="unrender-"))
    try:
        outcomes = in_turn(replace(job, folder=str(place)), tasks, problem)
        written = (path for path in place.rglob("*") if path.is_file() and CHECKPOINTS not in path.parts)
        return outcomes, {str(path.relative_to(place)): path.read_bytes() for path in written}
    finally:
        shutil.rmtree(place, ignore_errors=True)


def receive(folder: Path, written: Mapping[str, bytes]) -> None:
    """Write the files that a worker sent back. run.json comes last in each run folder. Raise `OSError`."""
    for name in sorted(written, key=lambda name: name.endswith(RECORD)):
        files.write(folder / name, written[name], durable=False)


def in_turn(job: Job, tasks: Sequence[RunTask], problem: Problem) -> list[RunOutcome]:
    """Run tasks in turn, without output, until one does not complete."""
    outcomes: list[RunOutcome] = []
    console, progress = quiet()
    with progress:
        for task in tasks:
            outcomes.append(carry_out(job, task, problem, console, progress))
            if outcomes[-1].status not in ENDED:
                break
    return outcomes


@functools.lru_cache(maxsize=1)
def _problem(name: str, options: tuple[tuple[str, str], ...], cached: bool) -> Problem:
    """Return the problem, opened once per process."""
    return arguments.open_problem(name, dict(options), cached)


# ---------------------------------------------------------------------- parts


def _resumed(folder: Path, problem: Problem, callbacks: Sequence[Callback], command: str) -> bool:
    """Resume the run from its last checkpoint if possible; return whether this succeeded."""
    try:
        stored = load_run(folder)
        live = Live(folder, problem.name, stored.record.method, command)
        resume_run(stored, problem, callbacks=[*callbacks, live], began=time.perf_counter())
        live.clear()
    except InputError:
        return False
    return True


def _wait_until_free(folder: Path) -> None:
    until = time.monotonic() + _PATIENCE_SECONDS
    while time.monotonic() < until and holder(folder) is not None:
        time.sleep(0.2)


def _finite(number: float | None) -> Any:
    return number if number is not None and abs(number) < float("inf") else None
