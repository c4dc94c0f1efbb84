"""`unrender resume`: continue a run from its last checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from unrender.app.cli import arguments, dealing, stages
from unrender.app.cli.arguments import AllowOutside, Insecure, Threads, WorkersOption
from unrender.app.cli.dealing import Compress
from unrender.app.cli.run import conclude
from unrender.core import phases
from unrender.core.errors import InputError


def resume(
    context: typer.Context,
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="A run folder, or the folder of a run in stages.")],
    steps: Annotated[
        int | None, typer.Option(help="Stop after that many steps, counted from the run's start. [default: as the run]")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Stop after that much time, likewise.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Go on though the problem, its files or versions changed since.")
    ] = False,
    variant: Annotated[str | None, typer.Option(help="Mitsuba's variant. [default: the run's]")] = None,
    threads: Threads = None,
    workers: WorkersOption = None,
    compress: Compress = False,
    allow_outside: AllowOutside = False,
    insecure: Insecure = False,
) -> None:
    """Go on with a run that was interrupted or killed, or give a finished one more.

    It goes on from its last checkpoint and becomes the run that it would have been without the interruption: to the bit with as many
    workers as it had, else up to rounding. Of a run in stages, the steps or seconds are those of all, for the stages that are left.
    """
    from unrender.display.terminal import Console
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
    if steps is not None or seconds is not None:
        steps, seconds = arguments.budget(steps, seconds)
    if (directory / "stages.toml").is_file() and not (directory / "run.json").is_file():
        if force:
            raise InputError(f"{directory}: --force goes with the run folder of a stage")
        stages.refuse_workers(workers)
        command = arguments.command_line(context)
        with Progress(console) as progress:
            return stages.run_remaining(
                stages.reopen(directory, (steps, seconds), variant, threads, command), console, progress
            )
    with Progress(console) as progress:
        with phases.phase("loading"):
            from unrender.app.cli.execute import introduce
            from unrender.runs import reopen
            from unrender.runs.live import Live
            from unrender.runs.resume import load_run, resume_run

            processes = dealing.check(workers, compress, insecure)
            found = load_run(directory, steps, seconds)
            alone = 1 if found.method.threads == 1 else None  # such a run repeats bit for bit
            running = arguments.use_variant(variant or found.record.variant or "auto", threads or alone)
            problem = reopen.problem_of(directory)
        introduce(console, problem, running)
        live = Live(directory, problem.name, found.record.method, found.record.command)
        theirs = dealing.variant_again(variant, found.record)
        with dealing.dealt(problem, processes, compress, theirs, threads or alone, console) as dealt:
            result = resume_run(found, dealt, force, [progress, live], earlier=progress.seconds, within_seconds=True)
        live.clear()
        conclude(console, problem, result, directory, progress)
