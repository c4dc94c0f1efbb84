"""`unrender run` and `resume` of a file of stages: one run folder per stage, in sequence."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from unrender.app.cli import arguments
from unrender.app.cli.signals import DOUBTFUL
from unrender.core import lazy, phases
from unrender.core.errors import InputError, prefixed
from unrender.core.random import check_seed

if TYPE_CHECKING:
    import numpy as np

    from unrender import methods
    from unrender.app.stages import stages_file
    from unrender.app.stages.stage_problem import StagedProblem
    from unrender.app.stages.stages_file import RunOptions, Stages
    from unrender.display.terminal import Console
    from unrender.runs.folder import reader, schema
    from unrender.runs.folder.lock import Lock
    from unrender.runs.progress import Progress
    from unrender.runs.result import Result
    from unrender.scene.problem import Problem
else:  # imported when a command needs them
    methods, stages_file = lazy.modules("methods", "app.stages.stages_file")
    reader, schema = lazy.modules("runs.folder.reader", "runs.folder.schema")

_SCENES = "scenes"


@dataclass(frozen=True)
class StagesRun:
    """A run in stages in progress. `run_remaining` releases its lock, and results contain the typed command."""

    stages: Stages
    problem: StagedProblem
    out: Path
    variant: str
    command: str
    lock: Lock

    @property
    def options(self) -> RunOptions:
        assert self.stages.run is not None
        return self.stages.run


def refuse_workers(workers: str | None) -> None:
    """Raise `InputError` if --workers is given."""
    if workers is not None:
        raise InputError("--workers: not supported with stages; leave it out")


def refuse_settings(
    method: str, settings: Mapping[str, str], options: Mapping[str, str], workers: str | None, no_cache: bool
) -> None:
    """Raise `InputError` for command-line options that belong in a file of stages, or that stages do not support."""
    refuse_workers(workers)
    refused = [f"--set {name}" for name in settings] + [f"--problem-set {name}" for name in options]
    refused += ["--method"] * (method != "auto")
    if no_cache:
        raise InputError("--no-cache: not supported with stages; leave it out")
    if refused:
        raise InputError(f"{refused[0]}: not supported with stages; set it in the file of stages")


def begin(
    file: Path,
    budget: tuple[int | None, float | None],
    seed: int | None,
    out: Path | None,
    overwrite: bool,
    variant: str,
    threads: int | None,
    command: str,
    checkpoint_every: int | None,
    final_spp: int | None,
) -> StagesRun:
    """Check a file of stages, and write the folder `out` of its run, a new one if None. Raise `InputError`.

    None as `seed`, and a budget of two None, select the file's values.
    """
    stages = stages_file.read(file)
    if budget != (None, None):
        stages = replace(stages, steps=budget[0], seconds=budget[1])
    steps, seconds = arguments.budget(stages.steps, stages.seconds)
    stages = replace(stages, steps=steps, seconds=seconds, seed=stages.seed if seed is None else seed)
    check_seed("seed", stages.seed, len(stages.stages))
    for stage in stages.stages:
        with prefixed(f"{file}: stage {stage.name}"):
            chosen, settings = methods.method(stage.method or stages.method), stages.settings_of(stage)
            if stages.settings:  # those that stages share may have no effect in this one
                chosen.configure(settings).build()
            else:
                chosen.start(settings)
    if out is not None and out.resolve() == file.resolve().parent:
        raise InputError(f"--out {out}: the folder of {file.name} itself; give another one")
    if out is not None and (out / stages_file.FILE).is_file() and not stages_file.is_of_run(out / stages_file.FILE):
        raise InputError(f"--out {out}: its {stages_file.FILE} is that of no run; give another folder")
    folder = arguments.folder(out, f"{file.resolve().parent.name}-stages", overwrite, stages_file.FILE)
    try:
        running = arguments.use_variant(variant, threads)
        problem = _read(stages)
        with _held(folder) as lock:
            _clear(folder)
            options = stages_file.RunOptions(running, threads, checkpoint_every, final_spp)
            stages = replace(stages, run=options)
            stages_file.write(stages, folder)
    finally:
        arguments.remove_if_empty(folder)
    return StagesRun(stages, problem, folder, running, command, lock)


def reopen(
    folder: Path, budget: tuple[int | None, float | None], variant: str | None, threads: int | None, command: str
) -> StagesRun:
    """Return an earlier run in stages. None, and a budget of two None, select the run's own values. Raise `InputError`."""
    file = folder / stages_file.FILE
    stages = stages_file.read(file)
    if not stages_file.is_of_run(file):
        raise InputError(
            f"{folder}: not a run in stages, since {file.name} has no absolute path of its problem; start one: unrender run {file}"
        )
    folders = [stages_file.folder_of(stages, index, folder) for index in range(len(stages.stages))]
    if all(_status(each) in schema.ENDED for each in folders):
        raise InputError(
            f"{folder}: all stages have ended; to continue the last one, give --steps or --seconds, counted from its start: "
            f"unrender resume {shlex.quote(str(folders[-1]))}"
        )
    if budget != (None, None):
        stages = replace(stages, steps=budget[0], seconds=budget[1])
    options = stages.run or stages_file.RunOptions()
    running = arguments.use_variant(variant or options.variant, threads or options.threads)
    stages = replace(stages, run=options)
    with _held(folder) as lock:
        problem = _read(stages)
        if budget != (None, None):
            stages_file.write(stages, folder)
    return StagesRun(stages, problem, folder, running, command, lock)


def run_remaining(run: StagesRun, console: Console, progress: Progress) -> None:
    """Run the remaining stages, and release the lock.

    The next stage after a doubtful one starts with the parameters that this verified. Raises `typer.Exit` if a stage was interrupted or
    failed, which ends the run, or if a stage is doubtful at the end.
    """
    try:
        _run_stages(run, console, progress)
    finally:
        run.lock.release()


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[Lock]:
    """Yield the folder's lock, which is only released if the block fails. Raise `InputError` if another process holds it."""
    from unrender.runs.folder.lock import Lock

    lock = Lock(folder)
    lock.acquire()
    try:
        yield lock
    except BaseException:
        lock.release()
        raise


def _run_stages(run: StagesRun, console: Console, progress: Progress) -> None:
    from rich.markup import escape

    from unrender.app.cli.run import conclude

    values: dict[str, np.ndarray] = {}
    doubtful = False
    due = progress.budget_began  # a stage loses the time that loading and earlier stages have taken from it
    for index, stage in enumerate(run.stages.stages):
        folder = stages_file.folder_of(run.stages, index, run.out)
        console.print(f"[bold]stage {index + 1} of {len(run.stages.stages)}[/]: {escape(stage.name)}", soft_wrap=True)
        if (status := _status(folder)) in schema.ENDED:
            console.say(f"{status}: {folder}")
            doubtful |= status in schema.DOUBTFUL
        else:
            seconds = None if (folder / schema.RECORD).is_file() else stages_file.split(run.stages)[index][1]
            now = time.perf_counter()
            progress.budget_began = now if seconds is None else min(due, now)
            due = progress.budget_began + (seconds or 0.0)
            problem, result = _run_stage(run, index, values, console, progress)
            last = index == len(run.stages.stages) - 1
            page = last or run.options.final_spp is not None
            try:
                conclude(console, problem, result, folder, progress, again=run.out, page=page)
            except typer.Exit as left:
                if left.exit_code != DOUBTFUL:
                    raise
                doubtful = True
        # Read the file, so that a stage has the same start whether the previous one ran just now or earlier.
        values |= reader.read(folder).parameters
    if doubtful:
        raise typer.Exit(DOUBTFUL)


def _run_stage(
    run: StagesRun, index: int, values: Mapping[str, Any], console: Console, progress: Progress
) -> tuple[Problem, Result]:
    from unrender.app.cli.execute import RunOrder, execution, introduce, resumed
    from unrender.runs import reopen as runs
    from unrender.runs.optimize import optimize
    from unrender.runs.resume import load_run

    stages, stage = run.stages, run.stages.stages[index]
    folder = stages_file.folder_of(stages, index, run.out)
    if (folder / schema.RECORD).is_file():
        stored = load_run(folder, *stages_file.split(stages)[index])
        problem = runs.problem_of(folder)
        introduce(console, problem, run.variant)
        return problem, resumed(stored, problem, progress)
    with phases.phase("loading"):
        problem = run.problem.of_stage(stage, values, run.out / _SCENES / folder.name)
    introduce(console, problem, run.variant)
    steps, seconds = stages_file.split(stages)[index]
    settings = stages.settings_of(stage)
    chosen = methods.method(stage.method or stages.method)
    shared = chosen.with_effect(problem, settings)  # those of all stages may have none in this one
    for key in [key for key in settings if key not in shared and key not in stage.settings]:
        console.say(f"setting {key}={settings.pop(key)}: it has no effect in this stage, and is left out")
    last = index == len(stages.stages) - 1
    spp = run.options.final_spp or (None if last else 1)  # final pictures of many views take minutes
    every = run.options.checkpoint_every
    order = RunOrder(chosen, settings, steps, seconds, stages.seed + index, spp, run.command, {}, every)
    with execution(problem, order, folder, console, progress) as arguments_of_run:
        return problem, optimize(**arguments_of_run)


def _read(stages: Stages) -> StagedProblem:
    from unrender.app.stages.stage_problem import StagedProblem

    with phases.phase("loading"):
        return StagedProblem.read(stages)


def _status(folder: Path) -> str:
    return reader.read_run_record(folder).status if (folder / schema.RECORD).is_file() else ""


def _clear(out: Path) -> None:
    """Remove the scenes and run folders of an earlier run in stages. Raise `InputError` if a process holds one."""
    old = [
        path
        for path in sorted(out.glob("[0-9]*-*"))
        if (path / schema.RECORD).is_file() or (path / schema.LOCK).is_file()
    ]
    with contextlib.ExitStack() as stack:
        for path in old:  # lock all before any is removed
            stack.callback(stack.enter_context(_held(path)).release)
        for path in old:
            shutil.rmtree(path)
        if (out / _SCENES).is_dir():
            shutil.rmtree(out / _SCENES)
