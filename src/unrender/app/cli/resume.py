"""`unrender resume`: continue a run from its last checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from unrender.app.cli import arguments, distribution, stages
from unrender.app.cli.arguments import AllowOutside, Insecure, Threads, WorkersOption
from unrender.app.cli.distribution import Compress
from unrender.app.cli.run import conclude
from unrender.core import phases
from unrender.core.errors import InputError


def resume(
    context: typer.Context,
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="A run folder, or the folder of a run in stages.")],
    steps: Annotated[
        int | None, typer.Option(help="Stop after this number of steps from the run's start. [default: the run's]")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Stop after this many seconds from the run's start.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Continue even if the problem, its files or versions have changed.")
    ] = False,
    variant: Annotated[str | None, typer.Option(help="Mitsuba's variant. [default: the run's]")] = None,
    threads: Threads = None,
    workers: WorkersOption = None,
    compress: Compress = False,
    allow_outside: AllowOutside = False,
    insecure: Insecure = False,
) -> None:
    """Continue an interrupted or killed run, or extend a finished one.

    It continues from its last checkpoint and gives the result of an uninterrupted run up to rounding; with --threads 1 and the same
    number of workers, bit for bit. For a run in stages, --steps and --seconds are a new budget of all stages.
    """
    from unrender.display.terminal import Console
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
    if steps is not None or seconds is not None:
        steps, seconds = arguments.budget(steps, seconds)
    if (directory / "stages.toml").is_file() and not (directory / "run.json").is_file():
        if force:
            raise InputError(f"{directory}: --force applies to the run folder of a stage; give that instead")
        stages.refuse_workers(workers)
        distribution.check(None, compress, insecure)  # options of workers
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

            processes = distribution.check(workers, compress, insecure)
            stored = load_run(directory, steps, seconds)
            alone = 1 if stored.method.threads == 1 else None  # such a run is reproducible bit for bit
            running = arguments.use_variant(variant or stored.record.variant or "auto", threads or alone)
            problem = reopen.problem_of(directory)
        introduce(console, problem, running)
        live = Live(directory, problem.name, stored.record.method, stored.record.command)
        theirs = distribution.variant_again(variant, stored.record)
        with distribution.distributed(problem, processes, compress, theirs, threads or alone, console) as shared:
            listeners, spent = [progress, live], progress.seconds
            result = resume_run(stored, shared, force, listeners, earlier=spent, began=progress.budget_began)
        live.clear()
        conclude(console, problem, result, directory, progress)
