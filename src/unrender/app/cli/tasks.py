"""Runs of `compare` and `sweep` as tasks: their input, execution on a worker, output, and display while they run."""

from __future__ import annotations

import contextlib
import functools
import io
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich import live
from rich.text import Text

from unrender.app.cli import arguments
from unrender.app.cli.execute import RunOrder, execution, resumed
from unrender.app.distributed.cluster import prepare_worker
from unrender.app.sweeps.record import RunOutcome, initial_errors, stated_error
from unrender.core.errors import InputError
from unrender.core.text import visible
from unrender.display import formatting
from unrender.display.terminal import Console, Group, Renderable, columns
from unrender.io import bounded_files, files
from unrender.methods import method
from unrender.runs.folder import reader, schema
from unrender.runs.folder.lock import holder
from unrender.runs.folder.schema import CHECKPOINTS, ENDED, LIVE, LIVE_STATUS, RECORD, LiveStatus
from unrender.runs.optimize import optimize
from unrender.runs.progress import Progress
from unrender.runs.resume import load_run
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
        method, settings: as typed.
        steps, seconds, seed, final_spp: see `RunOrder`.
    """

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
    _wait_until_free(folder)
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
    """Return the problem, opened once per process."""
    return arguments.open_problem(name, dict(options), cached)


# ---------------------------------------------------------------------- parts


def _resumed(folder: Path, problem: Problem, progress: Progress) -> bool:
    """Resume the run from its last checkpoint if possible; return whether this succeeded."""
    try:
        resumed(load_run(folder), problem, progress)
    except InputError:
        return False
    return True


def _wait_until_free(folder: Path) -> None:
    until = time.monotonic() + _PATIENCE_SECONDS
    while time.monotonic() < until and holder(folder) is not None:
        time.sleep(0.2)


def _finite(number: float | None) -> Any:
    return number if number is not None and abs(number) < float("inf") else None


_PER_SECOND = 2.0
_MOST_ROWS = 20


@dataclass(frozen=True)
class _Task:
    """A running task: its label, start time, and possible run folders."""

    label: str
    since: float
    folders: tuple[Path, ...]


class TaskDisplay:
    """Shows the running tasks. Use as a context manager.

    Args:
        console: output console.
        what: name of the tasks, such as "trials".
        below: renderable below the table of running tasks; None for nothing.
    """

    def __init__(self, console: Console, total: int, what: str, below: Callable[[], Renderable] | None = None):
        self._console, self._total, self._what, self._below = console, total, what, below
        self._running: dict[object, _Task] = {}
        self._ended = 0
        self._began = time.monotonic()
        self._lock = threading.Lock()
        self._live: live.Live | None = None

    def __enter__(self) -> TaskDisplay:
        if self._console.is_terminal:
            self._live = live.Live(
                get_renderable=self._render, console=self._console, refresh_per_second=_PER_SECOND, transient=True
            )
            self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.__exit__(None, None, None)
            self._live = None

    def begin(self, key: object, label: str, folders: tuple[Path, ...]) -> None:
        """Record the start of a task, which uses these run folders in turn."""
        with self._lock:
            self._running[key] = _Task(label, time.monotonic(), folders)

    def end(self, key: object, line: str) -> None:
        """Record the end of a task, with its summary line."""
        with self._lock:
            self._running.pop(key, None)
            self._ended += 1
        if self._live is None:
            self.say(f"{self._ended}/{self._total} {line}")

    def skip(self, count: int) -> None:
        """Record tasks that had ended before."""
        self._ended += count

    def say(self, line: str) -> None:
        """Print a permanent line."""
        self._console.say(visible(line))
        self._console.file.flush()

    def _render(self) -> Renderable:
        with self._lock:
            rows, ended = list(self._running.values()), self._ended
        elapsed = formatting.duration(time.monotonic() - self._began)
        head = Text(f"{ended} of {self._total} {self._what} ended, {len(rows)} running, {elapsed}")
        table = columns("running", "seed", "step", "loss", "since")
        for row in rows[:_MOST_ROWS]:
            folder, status = _live_status(row.folders)
            since = formatting.duration(time.monotonic() - row.since)
            if status is None:
                table.add_row(Text(visible(row.label)), "", "starting", "", since)
                continue
            step = f"{status.step}/{status.steps}" if status.steps else str(status.step)
            loss = "" if status.loss is None else f"{status.loss:.4g}"
            seed = folder.name.rpartition("-seed")[2]
            table.add_row(Text(visible(row.label)), seed, step, loss, since)
        parts: list[Renderable] = [head, table]
        if self._below is not None:
            parts.append(self._below())
        return Group(*parts)


def _live_status(folders: tuple[Path, ...]) -> tuple[Path, LiveStatus | None]:
    """Return the folder of the current run and its live status; the first folder and None if no status is visible."""
    for folder in folders:
        path = folder / LIVE / LIVE_STATUS
        with contextlib.suppress(InputError, OSError):
            if path.is_file():
                return folder, schema.validate(LiveStatus, bounded_files.read_object(path, folder), str(path))
    return folders[0], None
