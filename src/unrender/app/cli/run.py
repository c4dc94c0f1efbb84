"""`unrender run` recovers one problem's parameters by one method, and `unrender resume` continues a run from its last checkpoint."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unrender.app.cli import arguments, stages
from unrender.app.cli.signals import DOUBTFUL, FAILED, INTERRUPTED, TERMINATED
from unrender.backend.variant import VARIANTS
from unrender.core import phases
from unrender.core.errors import InputError
from unrender.display.terminal import Console

if TYPE_CHECKING:
    from unrender.app.distributed.cluster import Workers
    from unrender.methods import Method
    from unrender.methods.plan import PlanFile
    from unrender.runs.folder.schema import RunRecord
    from unrender.runs.progress import Progress
    from unrender.runs.result import Result
    from unrender.scene.problem import Problem


def variant_again(typed: str | None, record: RunRecord) -> str:
    """Return the Mitsuba variant of the workers of a resumed run: the typed one, else the run's, else `auto`."""
    before = record.problem.description.get("workers")
    return typed or (before if before in VARIANTS else "auto")


@contextlib.contextmanager
def distributed(
    problem: Problem, workers: Workers | None, variant: str, threads: int | None, console: Console
) -> Iterator[Problem]:
    """Yield the problem with its views distributed to workers; the problem itself for None. See `unrender.app.distribute`."""
    if workers is None:
        yield problem
        return
    from rich.markup import escape

    from unrender.app.distributed.distribute import distribute

    def tell(line: str) -> None:
        console.print(f"[yellow]workers[/] {escape(line)}", soft_wrap=True)

    with contextlib.ExitStack() as stack:
        with phases.phase("workers"):
            inner = stack.enter_context(distribute(problem, workers, variant, threads, tell))
        yield inner


_MethodName = Annotated[
    str, typer.Option("--method", "-m", metavar="NAME", help="A method (`unrender methods`) or a plan file (TOML).")
]
_Settings = Annotated[
    list[str] | None,
    typer.Option("--set", "-s", metavar="NAME=VALUE", help="An option of the method, such as spp=4. Repeatable."),
]
_Steps = Annotated[int | None, typer.Option(help="Number of steps. [default: 300 without --seconds]")]
_Seconds = Annotated[
    float | None, typer.Option(help="Time with compilation and final pictures. Steps get at least half of it.")
]
_Out = Annotated[Path | None, typer.Option(help="The run folder. Default: a new one in out/.")]


def run(
    context: typer.Context,
    problem: arguments.ProblemName,
    method_name: _MethodName = "auto",
    settings: _Settings = None,
    steps: _Steps = None,
    seconds: _Seconds = None,
    seed: arguments.Seed = 0,
    out: _Out = None,
    problem_settings: arguments.ProblemSettings = None,
    variant: arguments.Variant = "auto",
    final_spp: arguments.FinalSpp = None,
    overwrite: arguments.Overwrite = False,
    checkpoint_every: arguments.CheckpointEvery = None,
    threads: arguments.Threads = None,
    no_cache: arguments.NoCache = False,
    workers: arguments.WorkersOption = None,
    allow_outside: arguments.AllowOutside = False,
    insecure: arguments.Insecure = False,
) -> None:
    """Recover a problem's parameters, and write a run folder with a page that shows the result.

    PROBLEM may also be a file of stages: each stage has a run folder and starts from the result of the previous stage. Ctrl-C and
    SIGTERM stop after the current step and save the state; `unrender resume` continues from there.
    """
    values, options = arguments.settings(settings, "--set"), arguments.settings(problem_settings, "--problem-set")
    steps, seconds = _budget_settings(values, steps, seconds)
    budget = arguments.budget(steps, seconds)
    arguments.check_file(problem, options)
    from unrender.runs.progress import Progress

    console, command = Console(highlight=False), arguments.command_line(context)
    with Progress(console, arguments.began(context)) as progress:  # options are refused before slow imports
        chosen, processes = _method(method_name), arguments.workers(workers, insecure)
        if arguments.is_stages(problem):
            stages.refuse_settings(method_name, values, options, workers, no_cache)
            first = seed if "--seed" in arguments.typed_options(context) else None
            plan = (steps, seconds), first, out, overwrite, variant, threads, command, checkpoint_every, final_spp
            return stages.run_remaining(stages.begin(Path(problem), *plan), console, progress)
        arguments.check_variant(variant)
        chosen.start(values)
        folder = arguments.folder(out, f"{arguments.short_name(problem)}-{chosen.name}", overwrite, "run.json", "lock")
        try:
            with phases.phase("loading"):
                from unrender.app.cli.execute import RunOrder, execution, introduce
                from unrender.runs.optimize import optimize

                arguments.check_problem(problem, options, not no_cache)
            running = arguments.use_variant(variant, threads)
            opened = arguments.open_problem(problem, options, not no_cache)
            introduce(console, opened, running)
            with distributed(opened, processes, variant, threads, console) as shared:
                task = RunOrder(chosen, values, *budget, seed, final_spp, command, options, checkpoint_every)
                with execution(shared, task, folder, console, progress) as order:
                    result = optimize(**order)
        finally:
            arguments.remove_if_empty(folder)
        conclude(console, opened, result, folder, progress)


def _method(name: str) -> Method | PlanFile:
    if not name.endswith(".toml"):
        from unrender.methods import method

        return method(name)
    from unrender.methods.plan import PlanFile

    return PlanFile(Path(name))


def conclude(
    console: Console,
    problem: Problem,
    result: Result,
    folder: Path,
    progress: Progress,
    again: Path | None = None,
    page: bool = True,
) -> None:
    """Write the page, unless `page` is False, and print a summary; `again` is the argument of `unrender resume`, None for the run folder.

    Raises `typer.Exit` if the run was interrupted, failed, or is doubtful.
    """
    from unrender.app.cli.execute import summarise

    written = None
    if result.steps and page:
        with phases.phase("page"):
            from unrender.app import report

            written = report.page(folder)
    summarise(console, problem, result, progress)
    if written is not None:
        console.say(f"page: {written}")
    if status := exit_status(result.stopped):
        why = "to continue" if result.status == "interrupted" else "to try once more from its last step"
        console.say(f"{why}: unrender resume {shlex.quote(str(again or folder))}")
        raise typer.Exit(status)
    if result.status != "finished":
        raise typer.Exit(DOUBTFUL)


def exit_status(stopped: str) -> int:
    """Return the exit status for the reason why a run ended (`Result.stopped`)."""
    from unrender.runs import result as results

    statuses = {results.INTERRUPTED: INTERRUPTED, results.TERMINATED: TERMINATED, results.NON_FINITE: FAILED}
    return statuses.get(stopped, 0)


def _budget_settings(
    typed: dict[str, str], steps: int | None, seconds: float | None
) -> tuple[int | None, float | None]:
    """Return the budget. It may also be given among the settings (--set steps=300), from which it is removed."""
    budget: dict[str, Any] = {"steps": steps, "seconds": seconds}
    for name in budget:
        if name in typed and budget[name] is not None:
            raise InputError(f"--set {name}={typed[name]}: --{name} is given as well; leave out one")
    for name, number, expected in (("steps", int, "a whole number"), ("seconds", float, "a number")):
        if name in typed:
            text = typed.pop(name)
            try:
                budget[name] = number(text)
            except ValueError as error:
                raise InputError(f"--set {name}={text}: expected {expected}") from error
    return budget["steps"], budget["seconds"]


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
    threads: arguments.Threads = None,
    workers: arguments.WorkersOption = None,
    allow_outside: arguments.AllowOutside = False,
    insecure: arguments.Insecure = False,
) -> None:
    """Continue an interrupted or killed run, or extend a finished one.

    It continues from its last checkpoint and gives the result of an uninterrupted run up to rounding; with --threads 1 and the same
    number of workers, bit for bit. For a run in stages, --steps and --seconds are a new budget of all stages.
    """
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
    arguments.check_folder(directory)
    if steps is not None or seconds is not None:
        steps, seconds = arguments.budget(steps, seconds)
    if (directory / "stages.toml").is_file() and not (directory / "run.json").is_file():
        if force:
            raise InputError(f"{directory}: --force applies to the run folder of a stage; give that instead")
        stages.refuse_workers(workers)
        arguments.workers(None, insecure)
        command = arguments.command_line(context)
        with Progress(console, arguments.began(context)) as progress:
            return stages.run_remaining(
                stages.reopen(directory, (steps, seconds), variant, threads, command), console, progress
            )
    with Progress(console, arguments.began(context)) as progress:
        with phases.phase("loading"):
            from unrender.app.cli.execute import introduce, resumed
            from unrender.runs import reopen
            from unrender.runs.resume import load_run

            processes = arguments.workers(workers, insecure)
            stored = load_run(directory, steps, seconds)
            alone = 1 if stored.method.threads == 1 else None  # such a run is reproducible bit for bit
            running = arguments.use_variant(variant or stored.record.variant or "auto", threads or alone)
            problem = reopen.problem_of(directory)
        introduce(console, problem, running)
        theirs = variant_again(variant, stored.record)
        with distributed(problem, processes, theirs, threads or alone, console) as shared:
            result = resumed(stored, shared, progress, force)
        conclude(console, problem, result, directory, progress)
