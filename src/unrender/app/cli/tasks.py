"""Runs of `compare` and `sweep` as tasks: their input, execution on a worker, output, and display while they run."""

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
from unrender.app.cli.execute import RunOrder, execution, resumed
from unrender.app.distributed.cluster import prepare_worker
from unrender.app.sweeps.record import RunOutcome, initial_errors, stated_error
from unrender.core.errors import InputError
from unrender.core.text import visible
from unrender.display.terminal import Console
from unrender.io import files
from unrender.methods import method
from unrender.runs.folder import reader
from unrender.runs.folder.lock import holder
from unrender.runs.folder.schema import CHECKPOINTS, ENDED, RECORD
from unrender.runs.optimize import optimize
from unrender.runs.progress import Progress
from unrender.runs.resume import load_run
from unrender.scene.problem import Problem

_PATIENCE_SECONDS = 30.0  # seconds to wait for a run folder that a dying process still locks
_MARK = ".unrender-folder"


@dataclass(frozen=True)
class Job:
    """Common data of all tasks of a command. It is serialisable.

    The paths of a problem file and of the folder are absolute. A worker that does not read the `token` in its file `.unrender-folder` sends
    its results back. Variant and threads are those of the workers.
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
    """One run, as typed: see `RunOrder`. It is serialisable."""

    name: str
    method: str
    settings: Mapping[str, str]
    steps: int | None
    seconds: float | None
    seed: int
    final_spp: int | None


@contextlib.contextmanager
def open_job(job: Job) -> Iterator[None]:
    """Mark the job's folder, so that workers can detect whether they share it."""
    mark = Path(job.folder, _MARK)
    files.write(mark, job.token.encode(), durable=False)
    try:
        yield
    finally:
        mark.unlink(missing_ok=True)


def carry_out(job: Job, task: RunTask, problem: Problem, console: Console, progress: Progress) -> RunOutcome:
    """Run a task, or continue its earlier attempt, and return its outcome. Raise `InputError` as `optimize` and `resume_run` do."""
    folder = Path(job.folder, task.name)
    until = time.monotonic() + _PATIENCE_SECONDS
    while time.monotonic() < until and holder(folder) is not None:
        time.sleep(0.2)
    record = reader.read_run_record(folder) if (folder / RECORD).is_file() else None
    started = progress.budget_began = time.perf_counter()
    if record is None or record.status not in ENDED:
        if record is None or record.steps == 0 or not _resumed(folder, problem, progress):
            chosen = method(task.method)
            order = RunOrder(
                chosen, task.settings, task.steps, task.seconds, task.seed, task.final_spp, job.command,
                job.problem_settings,
            )  # fmt: skip
            with execution(problem, order, folder, console, progress) as arguments_of_run:
                optimize(**arguments_of_run)
        return outcome(folder, task, initial_errors(problem), time.perf_counter() - started)
    return outcome(folder, task, initial_errors(problem), 0.0)


def outcome(folder: Path, task: RunTask, start: Mapping[str, float], wall_seconds: float) -> RunOutcome:
    """Return the outcome of a run from its folder; `start`: see `stated_error`. Raise `InputError`."""
    run = reader.read(folder)
    record = run.record
    try:
        error, standard_error = stated_error(run, start)
    except InputError:
        error = standard_error = None
    return RunOutcome(
        folder=task.name,
        seed=task.seed,
        status="failed" if record.status == "running" else record.status,
        stopped=record.stopped,
        error=_finite(error),
        standard_error=_finite(standard_error),
        steps=record.steps,
        samples=int(run.history.samples[-1]) if len(run.history) else 0,
        seconds=record.seconds,
        wall_seconds=wall_seconds,
    )


# ---------------------------------------------------------------------- worker


def on_worker(job: Job, tasks: Sequence[RunTask]) -> tuple[list[RunOutcome], dict[str, bytes]]:
    """Run tasks in turn, until one does not complete. Return their outcomes; and, if the job's folder is not shared, {path within it:
    contents} of the written files."""
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
    """Write the files that a worker sent back. run.json comes last in each run folder. Raise `InputError`."""
    for name in sorted(written, key=lambda name: name.endswith(RECORD)):
        files.write(folder / name, written[name], durable=False)


def in_turn(job: Job, tasks: Sequence[RunTask], problem: Problem) -> list[RunOutcome]:
    """Run tasks in turn, without output, until one does not complete."""
    outcomes: list[RunOutcome] = []
    console = Console(file=io.StringIO(), force_terminal=False)
    with Progress(console) as progress:
        for task in tasks:
            outcomes.append(carry_out(job, task, problem, console, progress))
            if outcomes[-1].status not in ENDED:
                break
    return outcomes


@functools.lru_cache(maxsize=1)
def _problem(name: str, options: tuple[tuple[str, str], ...], cached: bool) -> Problem:
    return arguments.open_problem(name, dict(options), cached)


# ---------------------------------------------------------------------- parts


def _resumed(folder: Path, problem: Problem, progress: Progress) -> bool:
    try:
        resumed(load_run(folder), problem, progress)
    except InputError:
        return False
    return True


def _finite(number: float | None) -> Any:
    return number if number is not None and abs(number) < float("inf") else None


class TaskDisplay:
    """Prints a line for each task that has ended, after those that had `ended` before. `unrender watch` shows those that run."""

    def __init__(self, console: Console, total: int, ended: int = 0):
        self._console, self._total, self._ended = console, total, ended

    def end(self, line: str) -> None:
        """Record the end of a task, with its summary line."""
        self._ended += 1
        self.say(f"{self._ended}/{self._total} {line}")

    def say(self, line: str) -> None:
        """Print a line."""
        self._console.say(visible(line))
        self._console.file.flush()
