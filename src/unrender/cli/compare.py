"""`unrender compare`: several methods, or runs made earlier, at equal time."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.cli import arguments
from unrender.cli.arguments import FinalSpp, NoCache, Overwrite, ProblemSettings, Variant
from unrender.cli.run import exit_status
from unrender.core import phases
from unrender.core.errors import InputError

if TYPE_CHECKING:
    from unrender.cli.execute import Plan
    from unrender.display.terminal import Console
    from unrender.methods import Method
    from unrender.runs.progress import Progress

__all__ = ["DEFAULT_SECONDS", "compare"]

DEFAULT_SECONDS = 20.0
_DEFAULT = ("stock", "auto")
"""What people have, and what they get here without an option."""
_MARKS = ("compare.json", "*-seed*/run.json", "*-seed*/lock")


def compare(
    context: typer.Context,
    what: Annotated[
        list[str],
        typer.Argument(metavar="PROBLEM | DIR...", help="A problem to run here, or run folders made earlier."),
    ],
    methods: Annotated[
        str | None, typer.Option(metavar="NAME,NAME", help="The first measures the others. [default: stock,auto]")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", "-s", metavar="[METHOD.]NAME=VALUE", help="An option of one method or of all, such as rcv.spp=4."
        ),
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Time for each run, without compilation. [default: 20]")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="How many runs of each method.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="The first run's seed.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Where the results go. Default: a new folder in out/.")] = None,
    problem_settings: ProblemSettings = None,
    variant: Variant = "auto",
    final_spp: FinalSpp = None,
    overwrite: Overwrite = False,
    no_cache: NoCache = False,
) -> None:
    """Compare methods at equal time on one problem, or runs made earlier.

    Every run gets the same seconds of optimization. Compiling kernels before the first step is left out for all alike.
    """
    from unrender.display.terminal import Console
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
    if all(Path(name).is_dir() for name in what):
        run_options = methods or settings or problem_settings or seconds is not None
        return _compare_folders(console, [Path(name) for name in what], out, overwrite, bool(run_options))
    _check_single(what)
    typed, options = arguments.settings(settings, "--set"), arguments.settings(problem_settings, "--problem-set")
    with Progress(console) as progress:
        chosen, given = _methods_and_settings(methods, typed)
        arguments.check_problem(what[0], options)
        _, seconds = arguments.budget(None, DEFAULT_SECONDS if seconds is None else seconds)
        folder = arguments.folder(out, f"{arguments.short_name(what[0])}-compare", overwrite, *_MARKS)
        try:
            from unrender.cli.execute import Plan, introduce

            running = arguments.use_variant(variant)
            problem = arguments.open_problem(what[0], options, not no_cache)
            introduce(console, problem, running)
            command = shlex.join(context.find_root().obj or ["unrender"])
            turns = itertools.product(range(seed, seed + seeds), chosen)  # a machine that slows down slows all methods
            plans = [Plan(problem, m, given[m.name], None, seconds, n, final_spp, command, options) for n, m in turns]
            directories, status = _run_all(console, plans, folder, progress)
        finally:
            arguments.remove_if_empty(folder)
        if directories:
            _report(console, directories, folder)
    if status:
        raise typer.Exit(status)


def _report(console: Console, directories: Sequence[Path], folder: Path) -> None:
    """Compare runs made here."""
    with phases.phase("page"):
        from unrender import report
        from unrender.cli import comparison_table

        comparison, notices = report.load_comparison(directories)
        page = report.write_comparison(comparison, notices, folder)
    comparison_table.show(console, comparison)
    console.print("Time of compilation is left out for every method alike.")
    console.print(f"page: {comparison_table.plain(str(page))}", soft_wrap=True)


def _check_single(what: Sequence[str]) -> None:
    """Raise `InputError` unless one problem is given."""
    if len(what) > 1:
        missing = next(name for name in what if not Path(name).is_dir())
        raise InputError(f"{missing}: no such run folder (give run folders, or one problem)")


def _compare_folders(
    console: Console, directories: Sequence[Path], out: Path | None, overwrite: bool, run_options: bool
) -> None:
    """Compare runs made earlier. `run_options`: whether options were given that only runs made here have."""
    if run_options:
        raise InputError("compare: run folders are compared as they are, without --methods, --set, --seconds")
    from unrender import report
    from unrender.cli import comparison_table

    folder = arguments.folder(out, "compare", overwrite, *_MARKS)
    try:
        comparison, notices = report.load_comparison(directories)
        page = report.write_comparison(comparison, notices, folder)
    finally:
        arguments.remove_if_empty(folder)
    comparison_table.show(console, comparison)
    for notice in notices:
        console.print(f"note: {comparison_table.plain(notice)}", soft_wrap=True)
    console.print(f"page: {comparison_table.plain(str(page))}", soft_wrap=True)


def _run_all(console: Console, plans: Sequence[Plan], folder: Path, progress: Progress) -> tuple[list[Path], int]:
    """Carry out the plans until one is interrupted.

    Returns the run folders of runs that took a step, and the exit status: of the one that was interrupted, or of one that failed, else 0.
    """
    from unrender.cli.execute import execute

    directories: list[Path] = []
    status = 0
    for plan in plans:
        console.print(f"[bold]{plan.method.name}[/], seed {plan.seed}, {plan.seconds:g} s")
        directory = folder / f"{plan.method.name}-seed{plan.seed}"
        result = execute(plan, directory, console, progress)
        if result.steps:
            directories.append(directory)
        status = exit_status(result) or status
        if result.status == "interrupted":
            break
    return directories, status


def _methods_and_settings(
    names: str | None, typed: Mapping[str, str]
) -> tuple[list[Method], dict[str, dict[str, str]]]:
    """The methods, and the settings of each, all of which it takes. Raises `InputError`."""
    with phases.phase("loading"):
        chosen = _parse_methods(names)
        given = _settings_by_method(chosen, typed)
        for one in chosen:
            one.start(given[one.name])
    return chosen, given


def _parse_methods(names: str | None) -> list[Method]:
    from unrender.methods import method

    if names is None:
        return [method(name) for name in _DEFAULT]
    chosen = [method(name.strip()) for name in names.split(",") if name.strip()]
    if not chosen:
        raise InputError("--methods: expected at least one name")
    for one in chosen:
        if chosen.count(one) > 1:
            raise InputError(f"--methods: {one.name} is given twice")
    return chosen


def _settings_by_method(chosen: Sequence[Method], given: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """The settings of each method: those without a method's name go to all, those with one to it, and win."""
    found: dict[str, dict[str, str]] = {one.name: {} for one in chosen}
    for name, value in given.items():
        if "." not in name:
            for settings in found.values():
                settings[name] = value
    for name, value in given.items():
        owner, dot, option = name.partition(".")
        if dot:
            if owner not in found:
                raise InputError(f"--set {name}={value}: {owner} is not one of the methods {', '.join(found)}")
            found[owner][option] = value
    return found
