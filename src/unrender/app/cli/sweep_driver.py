"""Runs the trials of a sweep, in this process or on workers, and writes their results to sweep.json."""

from __future__ import annotations

import contextlib
import math
import re
import secrets
import shlex
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from unrender.app.cli import arguments, results, signals, tasks
from unrender.app.cli.execute import introduce
from unrender.app.cli.signals import FAILED, INTERRUPTED, TERMINATED
from unrender.app.cli.tasks import Job, RunTask, TaskDisplay
from unrender.app.distributed.cluster import Ended, Executor, InProcess, OnWorkers, Workers, connect
from unrender.app.sweeps.record import (
    RUN_FOLDERS,
    SWEEP,
    Started,
    SweepPlan,
    SweepRecord,
    TrialRecord,
    Trials,
    best_folders,
    run_name,
    trial_record,
    write_sweep,
)
from unrender.app.sweeps.search import Search
from unrender.backend.variant import check_threads
from unrender.core.errors import InputError
from unrender.core.text import visible
from unrender.display import formatting
from unrender.display.terminal import Console, columns
from unrender.io import files
from unrender.runs.budget import few_steps
from unrender.runs.folder.lock import Lock
from unrender.runs.folder.schema import DOUBTFUL, ENDED, RECORD
from unrender.runs.result import TERMINATED as BY_SIGTERM
from unrender.scene.fingerprint import differences, digest, fingerprint, shortened
from unrender.scene.problem import Problem

_SHOWN = 10
_COMPUTED = re.compile(r"scene|value of the expression")
"""Parts of a fingerprint that a device computes from other parts."""
_RENDERED = re.compile(rf"{_COMPUTED.pattern}|view \d+: reference|loss near")
"""Those of a gallery problem."""
_LONGEST_PART = 200
_MANY = 1e9  # degrees of freedom of a standard error that is known


def line(trial: TrialRecord) -> str:
    """Return the line of a trial: number, settings, error with its standard error, and status."""
    what = f"trial {trial.number}: {_settings(trial.settings)}: "
    if trial.status == "failed":
        return f"{what}failed: {trial.message}"
    where = "".join(f" ({status})" for status in sorted({run.status for run in trial.runs} & DOUBTFUL))
    return f"{what}error {_error(trial)}{where}"


def show(console: Console, record: SweepRecord) -> None:
    """Print the outcome: the best trials, the number of trials, and the command for the best one."""
    if record.trials:
        console.print(_table(record.trials))
    counts = {status: sum(t.status == status for t in record.trials) for status in ("finished", "failed")}
    outcome = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    console.say(f"{outcome or 'no trial has ended'}; {formatting.duration(record.wall_seconds)} in all")
    reasons: dict[str, list[int]] = {}
    for trial in record.trials:
        if trial.status == "failed":
            reasons.setdefault(trial.message, []).append(trial.number)
    for message, numbers in reasons.items():
        which = ", ".join(map(str, numbers[:_SHOWN])) + (", …" if len(numbers) > _SHOWN else "")
        console.say(f"failed (trial {which}): {visible(message)}", style="red")
    if record.best_line:
        console.say(f"best: {record.best_line}")
        if others := equally_good(record):
            which = ", ".join(map(str, others[:_SHOWN])) + (", …" if len(others) > _SHOWN else "")
            console.say(f"not distinguished from it (5 %): trial {which}; more --final-spp or --seeds may decide")
        console.say(f"to run it: {run_command(record)}")


def equally_good(record: SweepRecord) -> list[int]:
    """Return the other finished trials that Welch's t test at 5 % does not tell from the best one."""
    known = {t.number: t for t in record.trials if t.status == "finished" and t.error is not None}
    best = known.pop(record.best, None) if record.best is not None else None
    return [] if best is None else [number for number, trial in known.items() if _is_alike(best, trial)]


def _is_alike(*trials: TrialRecord) -> bool:
    """Return whether two errors differ by no more than their noise. The standard error of few runs is itself uncertain."""
    from scipy.special import stdtrit

    one, other = (trial.error or 0.0 for trial in trials)
    squares = [(trial.standard_error or 0.0) ** 2 for trial in trials]
    if (total := sum(squares)) == 0.0:
        return False
    rest = sum(square**2 / (len(of.runs) - 1) for square, of in zip(squares, trials, strict=True) if len(of.runs) > 1)
    degrees = min(total**2 / rest, _MANY) if rest > 0.0 else _MANY  # a single run's error is a mean over many pixels
    return abs(one - other) <= float(stdtrit(degrees, 0.975)) * math.sqrt(total)


def run_command(record: SweepRecord) -> str:
    """Return the command of the first run of the best trial."""
    plan = record.plan
    words = ["unrender", "run", plan.problem, "--method", plan.method]
    words += [w for name, value in plan.problem_settings.items() for w in ("-p", f"{name}={value}")]
    words += [w for name, value in plan.settings.items() for w in ("-s", f"{name}={value}")]
    words += ["--steps", str(plan.steps)] if plan.steps is not None else []
    words += ["--seconds", f"{plan.seconds:g}"] if plan.seconds is not None else []
    words += ["--seed", str(plan.seed)] if plan.seed else []
    words += ["--final-spp", str(plan.final_spp)] if plan.final_spp is not None else []
    words += ["--variant", plan.variant] if plan.variant != "auto" else []
    return f"{shlex.join(words)} {record.best_line}"


def _table(trials: list[TrialRecord]) -> Table:
    known = [(t.error, t.number, t) for t in trials if t.error is not None and t.status == "finished"]
    ordered = [t for _, _, t in sorted(known, key=lambda entry: entry[:2])]
    names = list(ordered[0].settings) if ordered else []
    table = columns("trial", *names, "error", "steps", "seconds", "")
    for trial in ordered[:_SHOWN]:
        steps = "+".join(str(run.steps) for run in trial.runs)
        seconds = f"{sum(run.seconds for run in trial.runs):.1f}"
        values = [Text(visible(trial.settings.get(name, ""))) for name in names]
        note = "; ".join(sorted({run.status for run in trial.runs} & DOUBTFUL))
        table.add_row(str(trial.number), *values, _error(trial), steps, seconds, note)
    return table


def _error(trial: TrialRecord) -> str:
    if trial.error is None:
        return "–"
    if trial.standard_error is None:
        return formatting.number(trial.error)
    of_one_run = formatting.with_error if len(trial.runs) == 1 else formatting.with_standard_error
    return of_one_run(trial.error, trial.standard_error)


def _settings(values: Mapping[str, str]) -> str:
    return ", ".join(f"{name}={value}" for name, value in values.items())


_POLL_SECONDS = 0.5
_WINDOW = 4


@dataclass(frozen=True)
class Session:
    """One call of the command: workers or None for this process, threads per run, and whether the sweep starts `fresh` regardless of its
    folder."""

    folder: Path
    workers: Workers | None
    threads: int | None
    fresh: bool = False


@dataclass
class _State:
    """Mutable state of the sweep: its record, the running trials, and the start of the session."""

    record: SweepRecord
    trials: Trials
    running: dict[int, Started] = field(default_factory=dict)
    began: float = field(default_factory=time.monotonic)
    before: float = 0.0
    stopped: str = ""
    advised: bool = False

    def save(self, folder: Path, status: str = "running") -> None:
        best = self.trials.best
        ended = [trial for _, trial in sorted(self.trials.ended.items())]
        changes = {
            "status": status,
            "trials": ended,
            "best": None if best is None else best.number,
            "best_line": "" if best is None else best.line,
            "wall_seconds": self.before + time.monotonic() - self.began,
        }
        self.record = self.record.model_copy(update=changes)
        write_sweep(folder, self.record)


def run_trials(console: Console, session: Session, record: SweepRecord, search: Search) -> None:
    """Run the remaining trials, write the page, and print the results.

    Raises:
        InputError: the folder is in use or cannot be written, or the problem cannot be opened.
        typer.Exit: with the status of an interrupted sweep, or if no trial completed, or a run of the best one is doubtful.
    """
    plan = record.plan
    trials = Trials(search, plan.window or _WINDOW)
    trials.ended = {
        t.number: t for t in record.trials if search.learns or t.status != "failed"
    }  # failed trials are repeated
    state = _State(record, trials, before=record.wall_seconds)
    lock = Lock(session.folder)
    lock.acquire()
    try:
        if session.fresh:
            for path in session.folder.glob(RUN_FOLDERS):
                files.remove(path)
        if not trials.done:
            with _executor(console, session, state) as (executor, job, problem, running):
                introduce(console, problem, running)
                _choose_window(state, executor)
                _announce(console, session, state, executor)
                state.save(session.folder)
                _drive(console, session, state, executor, job)
        state.save(session.folder, "finished" if trials.done else "interrupted")
        show(console, state.record)
        if best_folders(session.folder, state.record):
            console.say(f"page: {results.write_page(session.folder, state.record)}")
    finally:
        if not trials.done and (session.folder / SWEEP).exists():
            state.save(session.folder, "interrupted")
            again = f"to continue: unrender sweep {shlex.quote(str(session.folder))}"
            console.say(again)
        lock.release()
    if not trials.done:
        raise typer.Exit(TERMINATED if state.stopped == BY_SIGTERM else INTERRUPTED)
    if (best := state.trials.best) is None:
        raise typer.Exit(FAILED)
    if any(run.status in DOUBTFUL for run in best.runs):
        raise typer.Exit(signals.DOUBTFUL)


def _choose_window(state: _State, executor: Executor) -> None:
    """Choose the number of concurrent trials, unless it was chosen before: at least twice the workers, so that none waits for a slow
    trial."""
    if state.record.plan.window is None:
        state.trials.window = max(_WINDOW, 2 * executor.slots)
        plan = state.record.plan.model_copy(update={"window": state.trials.window})
        state.record = state.record.model_copy(update={"plan": plan})


@contextlib.contextmanager
def _executor(console: Console, session: Session, state: _State) -> Iterator[tuple[Executor, Job, Problem, str]]:
    """Yield the executor of the trials, their common data, the problem, and the variant. Stores the problem's definition in the record."""
    record, plan = state.record, state.record.plan
    with contextlib.ExitStack() as stack:
        cluster = None
        if session.workers is not None:
            cluster = stack.enter_context(connect(session.workers, plan.variant))
            if session.threads is not None and cluster.address is None:
                check_threads(session.threads)
        running = arguments.use_variant(plan.variant, None if cluster else session.threads)
        problem = arguments.open_problem(plan.problem, plan.problem_settings, plan.cached)
        state.record = record = record.model_copy(
            update={"definition": _checked_definition(session.folder, record, problem)}
        )
        if plan.final_spp == 1 and not problem.has_truth:
            raise InputError(
                "--final-spp: expected 2 or more, since trials without a truth are ranked by final pictures"
            )
        job = Job(
            plan.problem,
            plan.problem_settings,
            plan.cached,
            record.command,
            str(session.folder.resolve()),
            secrets.token_hex(16),
            running if cluster is None else cluster.variant,
            1 if cluster is None else session.threads or cluster.share.threads,
        )
        stack.enter_context(tasks.open_job(job))
        if cluster is not None:
            yield OnWorkers(cluster, tasks.on_worker), job, problem, cluster.variant
        else:
            yield InProcess(lambda job, runs: (tasks.in_turn(job, runs, problem), {})), job, problem, running


def _checked_definition(folder: Path, record: SweepRecord, problem: Problem) -> dict[str, str]:
    """Return the parts of a problem that its files, or the gallery, define. Raise `InputError` if one has changed since the first run of
    the sweep, whose error was another one."""
    gallery = "file" not in problem.origin
    computed = _RENDERED if gallery else _COMPUTED
    parts = {part: text for part, text in fingerprint(problem).items() if not computed.match(part)}
    for key, unknown in problem.unknowns.items():
        if gallery:
            parts[f"parameter {key}: initial"] = _moments(unknown.initial)
        elif unknown.parameter.initial is None:  # the scene's, of which the files are parts
            del parts[f"parameter {key}: initial"]
        if unknown.truth is not None:
            parts[f"parameter {key}: truth"] = _moments(unknown.truth) if gallery else digest(unknown.truth.tobytes())
    parts = {part: text if len(text) <= _LONGEST_PART else digest(text.encode()) for part, text in parts.items()}
    begun = any((run / RECORD).is_file() for run in folder.glob(RUN_FOLDERS))
    if begun and record.definition and (changes := differences(record.definition, parts)):
        what = f"its problem has changed since trial 0: {shortened(changes)}"
        raise InputError(f"sweep {folder}: {what}; begin another sweep, or take the change back")
    return parts


def _moments(values: np.ndarray) -> str:
    """Return shape, mean and standard deviation of values that a gallery problem computes: their last digits depend on the machine."""
    return f"{values.shape} of mean {values.mean(dtype=float):.4g} and deviation {values.std(dtype=float):.4g}"


def _announce(console: Console, session: Session, state: _State, executor: Executor) -> None:
    plan = state.record.plan
    where = "in this process" if session.workers is None else f"on {executor.slots} workers"
    seeds = f", {plan.seeds} seeds each" if plan.seeds > 1 else ""
    left = state.trials.search.trials - len(state.trials.ended)
    had = f", {len(state.trials.ended)} done before" if state.trials.ended else ""
    console.say(f"{plan.method}, {plan.search}: {left} trials{seeds} {where}{had}")
    console.say(f"to watch them: unrender watch {shlex.quote(str(session.folder))}")


def _drive(console: Console, session: Session, state: _State, executor: Executor, job: Job) -> None:
    plan, trials = state.record.plan, state.trials
    display = TaskDisplay(console, trials.search.trials, len(trials.ended))
    while not trials.done and not state.stopped:
        while executor.pending < executor.slots and (started := trials.next()) is not None:
            state.running[started.number] = started
            executor.start(started.number, job, _tasks(plan, started))
        for ended in executor.wait(_POLL_SECONDS):
            record = _ended(session, state, ended)
            if record is None:
                break
            trials.end(record)
            display.end(line(record))
            _advise_on_few_steps(state, record, display)
            state.save(session.folder)


def _advise_on_few_steps(state: _State, record: TrialRecord, display: TaskDisplay) -> None:
    plan = state.record.plan
    ends = [run.steps for run in record.runs if run.status in ENDED]
    if (
        plan.seconds is not None
        and ends
        and not state.advised
        and (advice := few_steps(plan.seconds, min(ends), plan.steps))
    ):
        state.advised = True
        display.say(f"note: {advice}")


def _ended(session: Session, state: _State, ended: Ended) -> TrialRecord | None:
    """Return the record of a completed trial; None if this process is being stopped."""
    started = state.running.pop(ended.key)
    runs, message = [], ended.message
    if not message:
        runs, written = ended.value
        tasks.receive(session.folder, written)
        stopped = next((run.stopped for run in runs if run.status == "interrupted"), "")
        if stopped and session.workers is None:
            state.stopped = stopped
            return None
        message = f"{stopped} from outside" if stopped else ""
    return trial_record(started.number, started.settings, runs, ended.attempts, message)


def _tasks(plan: SweepPlan, started: Started) -> list[RunTask]:
    return [
        RunTask(
            run_name(started.number, plan.seed + i),
            plan.method,
            {**plan.settings, **started.settings},
            plan.steps,
            plan.seconds,
            plan.seed + i,
            plan.final_spp,
        )
        for i in range(plan.seeds)
    ]
