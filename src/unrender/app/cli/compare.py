"""`unrender compare`: methods, or earlier runs, at equal time."""

from __future__ import annotations

import contextlib
import itertools
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.app.cli import arguments
from unrender.app.cli.run import exit_status
from unrender.app.cli.signals import DOUBTFUL, FAILED
from unrender.core import lazy, phases
from unrender.core.errors import InputError
from unrender.core.random import check_seed
from unrender.display import formatting
from unrender.display.terminal import Console, columns, plain

if TYPE_CHECKING:
    from unrender.app.cli import tasks
    from unrender.app.cli.tasks import Job, RunTask
    from unrender.app.distributed.cluster import Cluster, Ended, Workers
    from unrender.app.report.equal_time import Comparison, Spread
    from unrender.app.sweeps.record import RunOutcome
    from unrender.methods import Method
    from unrender.runs.folder import schema
    from unrender.runs.progress import Progress
    from unrender.scene.problem import Problem
else:  # imported when a command needs them
    tasks, schema = lazy.modules("app.cli.tasks", "runs.folder.schema")

DEFAULT_SECONDS = 20.0
_DEFAULT = ("stock", "auto")  # default methods: the standard Mitsuba loop, and the automatic choice
_POLL_SECONDS = 0.5
_MARKS = ("compare.json", "*-seed*/run.json", "*-seed*/lock")

_Seconds = Annotated[
    float | None,
    typer.Option(help="Time for each run, with compilation and final pictures. [default: 20 without --steps]"),
]
_Steps = Annotated[int | None, typer.Option(help="Steps of each run.")]
_Methods = Annotated[
    str | None,
    typer.Option(metavar="NAME,NAME", help="The first is the reference of the others. [default: stock,auto]"),
]


def compare(
    context: typer.Context,
    what: Annotated[
        list[str], typer.Argument(metavar="PROBLEM | DIR...", help="A problem to run, or earlier run folders.")
    ],
    methods: _Methods = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", "-s", metavar="[METHOD.]NAME=VALUE", help="An option of one or all methods, such as rcv.spp=4."
        ),
    ] = None,
    seconds: _Seconds = None,
    steps: _Steps = None,
    seeds: Annotated[int, typer.Option(min=1, max=arguments.MOST_SEEDS, help="Number of runs of each method.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="The first run's seed.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Output folder. Default: a new folder in out/.")] = None,
    problem_settings: arguments.ProblemSettings = None,
    workers: arguments.WorkersOption = None,
    insecure: arguments.Insecure = False,
    variant: arguments.Variant = "auto",
    final_spp: arguments.FinalSpp = None,
    overwrite: arguments.Overwrite = False,
    no_cache: arguments.NoCache = False,
    allow_outside: arguments.AllowOutside = False,
) -> None:
    """Compare methods at equal time or steps on one problem, or compare earlier runs.

    Every run has the same budget, as in `unrender run`. With workers, several runs are concurrent, each with its share of the machine.
    """
    steps, seconds = arguments.budget(steps, DEFAULT_SECONDS if seconds is None and steps is None else seconds)
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
    check_seed("--seed", seed, seeds)
    where = arguments.workers(workers, insecure)
    if all(Path(name).is_dir() for name in what):
        return _compare_folders(console, context, [Path(name) for name in what], out, overwrite)
    _check_single(what)
    typed, options = arguments.settings(settings, "--set"), arguments.settings(problem_settings, "--problem-set")
    arguments.check_file(what[0], options)
    with Progress(console) as progress:
        by_method = _methods_and_settings(methods, typed)
        arguments.check_problem(what[0], options, not no_cache)
        folder = arguments.folder(out, f"{arguments.short_name(what[0])}-compare", overwrite, *_MARKS)
        try:
            from unrender.app.cli.tasks import Job, RunTask

            place, token = str(folder.resolve()), secrets.token_hex(16)
            command = arguments.command_line(context)
            job = Job(arguments.absolute(what[0]), options, not no_cache, command, place, token)
            turns = itertools.product(range(seed, seed + seeds), by_method)  # a slow machine affects all methods
            runs = [RunTask(f"{m}-seed{n}", m, by_method[m], steps, seconds, n, final_spp) for n, m in turns]
            directories, status = _run_all(console, progress, job, runs, variant, where)
        finally:
            arguments.remove_if_empty(folder)
        if directories:
            _report(console, directories, folder, new=True)
    if status:
        raise typer.Exit(status)


def _report(console: Console, directories: Sequence[Path], folder: Path, new: bool = False) -> None:
    with phases.phase("page"):
        from unrender.app import report

        comparison, notices = report.load_comparison(directories)
        page = report.write_comparison(comparison, notices, folder)
    _show(console, comparison)
    for notice in notices:
        console.say(f"note: {notice}")
    if new:
        console.print("Times are those of the steps, without compilation and final pictures.")
    console.say(f"page: {page}")


def _show(console: Console, comparison: Comparison) -> None:
    """Print the median and range over each method's runs, for every metric and for the final pictures."""
    from unrender.app.report.equal_time import LOSS_WINDOW
    from unrender.losses.metrics import has_flip

    parameters = [metric for metric in comparison.metrics if metric.name != "loss"]
    for metric in parameters or comparison.metrics:
        window = f" (median over the last {LOSS_WINDOW:.0%} of the time)" if metric.name == "loss" else ""
        console.print(f"[bold]{plain(metric.title)}[/]{window}", soft_wrap=True)
        first = metric.methods[comparison.groups[0].label]
        times = [f"at {formatting.duration(moment.seconds)}" for moment in first.moments]
        table = columns("method", "runs", *times, f"after {formatting.count(comparison.samples)} paths")
        for group in comparison.groups:
            outcome = metric.methods[group.label]
            cells = [moment.error for moment in (*outcome.moments, outcome.at_samples[-1])]
            table.add_row(plain(group.label), str(len(group.runs)), *map(_spread, cells))
        console.print(table)
    if comparison.image_error[comparison.groups[0].label].median is not None:
        console.print("[bold]Last pictures, each run's at its own end[/]")
        table = columns("method", *comparison.images)
        for group in comparison.groups:
            table.add_row(plain(group.label), *(_spread(of[group.label]) for of in comparison.images.values()))
        console.print(table)
        if not has_flip():
            console.say("FLIP is left out: its package is missing (pip install 'unrender[flip]')")


def _spread(of: Spread) -> str:
    if of.median is None:
        return "–"
    middle = formatting.number(of.median)
    low, high = formatting.number(of.low), formatting.number(of.high)
    return middle if low == high else f"{middle} ({low}–{high})"


def _check_single(what: Sequence[str]) -> None:
    if len(what) > 1:
        missing = next(name for name in what if not Path(name).is_dir())
        what_is = "not a run folder" if Path(missing).exists() else "no such run folder"
        raise InputError(f"{missing}: {what_is}; give one problem, or several run folders")


def _compare_folders(
    console: Console, context: typer.Context, directories: Sequence[Path], out: Path | None, overwrite: bool
) -> None:
    if refused := arguments.typed_options(context, ("out", "overwrite", "allow_outside")):
        raise InputError(f"compare: {refused[0]} does not apply to run folders; leave it out")
    folder = arguments.folder(out, "compare", overwrite, *_MARKS)
    try:
        _report(console, directories, folder)
    finally:
        arguments.remove_if_empty(folder)


def _run_all(
    console: Console, progress: Progress, job: Job, runs: Sequence[RunTask], variant: str, workers: Workers | None
) -> tuple[list[Path], int]:
    """Carry out the runs, here or on workers, until one is interrupted. Return the folders of runs that took a step, and `status_of`
    all."""
    from unrender.app.cli.execute import introduce

    folder = Path(job.folder)
    with contextlib.ExitStack() as stack:
        cluster = None
        if workers is not None:
            from unrender.app.distributed.cluster import connect

            cluster = stack.enter_context(connect(workers, variant))
            job = replace(job, variant=cluster.variant, threads=cluster.share.threads)
        running = arguments.use_variant(variant)
        problem = arguments.open_problem(job.problem, dict(job.problem_settings), job.cached)
        introduce(console, problem, running if cluster is None else cluster.variant)
        for run in runs:  # no run continues an earlier one
            (folder / run.name / schema.RECORD).unlink(missing_ok=True)
        if cluster is None:
            outcomes = _here(console, progress, job, runs, problem)
        else:
            outcomes = _on_workers(console, job, runs, cluster)
    names = [outcome.folder for outcome in outcomes if outcome.steps]
    directories = [folder / run.name for run in runs if run.name in names]
    return directories, status_of(outcomes)


def status_of(outcomes: Sequence[RunOutcome]) -> int:
    """Return the exit status of runs: of the one that was interrupted, of one that failed, or of one that is doubtful, else 0.

    A run that does not fit is doubtful only if no other run fits: a method that stalls is a result of the comparison.
    """
    interrupted = [outcome for outcome in outcomes if outcome.status == "interrupted"]
    if interrupted:
        return exit_status(interrupted[0].stopped)
    failed = any(exit_status(outcome.stopped) or outcome.message for outcome in outcomes)
    statuses = {outcome.status for outcome in outcomes}
    doubtful = statuses & (schema.DOUBTFUL - {schema.MISFIT}) or statuses == {schema.MISFIT}
    return FAILED if failed else DOUBTFUL if doubtful else 0


def _here(
    console: Console, progress: Progress, job: Job, runs: Sequence[RunTask], problem: Problem
) -> list[RunOutcome]:
    outcomes: list[RunOutcome] = []
    for run in runs:
        limits = (f"{limit:g} {unit}" for unit, limit in (("steps", run.steps), ("s", run.seconds)) if limit)
        console.print(f"[bold]{run.method}[/], seed {run.seed}, {', '.join(limits)}")
        outcomes.append(tasks.carry_out(job, run, problem, console, progress))
        if outcomes[-1].status == "interrupted":
            break
    return outcomes


def _on_workers(console: Console, job: Job, runs: Sequence[RunTask], cluster: Cluster) -> list[RunOutcome]:
    """Run as many runs concurrently as there are workers. A failed run is reported in one line, and the others continue. After an
    interrupt, return the completed runs, and the state of the others if they saved it within seconds."""
    from unrender.app.cli.tasks import TaskDisplay
    from unrender.app.distributed.cluster import OnWorkers
    from unrender.app.sweeps.record import RunOutcome

    waiting, folder = list(runs), Path(job.folder)
    outcomes: list[RunOutcome] = []
    executor = OnWorkers(cluster, tasks.on_worker)

    def take(ended: Ended) -> None:
        name, seed = ended.key
        outcome = RunOutcome(folder=name, seed=seed, status="failed", message=ended.message)
        if not ended.message:
            (outcome,), written = ended.value
            tasks.receive(folder, written)
        outcomes.append(outcome)
        display.end(f"{name}: {outcome.message or f'{outcome.status}, {outcome.steps} steps'}")

    console.print(f"{len(waiting)} runs on {executor.slots} workers, {job.threads} threads each")
    display = TaskDisplay(console, len(waiting))
    with tasks.open_job(job):
        try:
            while waiting or executor.pending:
                while waiting and executor.pending < executor.slots:
                    run = waiting.pop(0)
                    executor.start((run.name, run.seed), job, [run])
                for ended in executor.wait(_POLL_SECONDS):
                    take(ended)
        except KeyboardInterrupt:  # compare the completed runs; `main` knows the status
            for ended in executor.saved():
                take(ended)
    for outcome in outcomes:
        if outcome.message:
            console.say(f"{outcome.folder}: failed: {outcome.message}", style="red")
    return outcomes


def _methods_and_settings(names: str | None, typed: Mapping[str, str]) -> dict[str, dict[str, str]]:
    chosen = _parse_methods(names)
    by_method = _settings_by_method(chosen, typed)
    for one in chosen:
        one.start(by_method[one.name])
    return by_method


def _parse_methods(names: str | None) -> list[Method]:
    listed = _DEFAULT if names is None else [name.strip() for name in names.split(",") if name.strip()]
    from unrender.methods import method

    chosen = [method(name) for name in listed]
    if not chosen:
        raise InputError("--methods: expected at least one name")
    for one in chosen:
        if chosen.count(one) > 1:
            raise InputError(f"--methods: {one.name} is listed twice")
    return chosen


def _settings_by_method(chosen: Sequence[Method], typed: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Return the settings of each method. Those without a method's name apply to all; those with one take precedence."""
    by_method: dict[str, dict[str, str]] = {one.name: {} for one in chosen}
    for name, value in typed.items():
        if "." not in name:
            for settings in by_method.values():
                settings[name] = value
    for name, value in typed.items():
        owner, dot, option = name.partition(".")
        if dot:
            if owner not in by_method:
                raise InputError(f"--set {name}={value}: {owner} is not one of the methods {', '.join(by_method)}")
            by_method[owner][option] = value
    return by_method
