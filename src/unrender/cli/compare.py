"""`unrender compare`: several methods, or runs made earlier, at equal time."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from unrender import report
from unrender.cli import arguments
from unrender.cli.arguments import FinalSpp, Overwrite, ProblemSettings, Variant
from unrender.cli.execute import Plan, execute, introduce
from unrender.cli.run import exit_status
from unrender.cli.terminal import Console
from unrender.core.errors import InputError
from unrender.core.text import visible
from unrender.evaluation.metrics import has_flip
from unrender.methods import Method, method
from unrender.report import formatting
from unrender.report.equal_time import Comparison, Spread

__all__ = ["DEFAULT_SECONDS", "compare"]

DEFAULT_SECONDS = 20.0
_MARKS = ("compare.json", "*-seed*/run.json", "*-seed*/lock")


def compare(
    context: typer.Context,
    what: Annotated[
        list[str],
        typer.Argument(metavar="PROBLEM | DIR...", help="A problem to run here, or run folders made earlier."),
    ],
    methods: Annotated[
        str | None, typer.Option(metavar="NAME,NAME", help="Methods to run; the first is the measure of the others.")
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
) -> None:
    """Compare methods at equal time on one problem, or runs made earlier.

    Every run gets the same seconds of optimization. Compiling kernels before the first step is left out for all alike.
    """
    console = Console(highlight=False)
    if all(Path(name).is_dir() for name in what):
        if methods or settings or problem_settings or seconds is not None:
            raise InputError("compare: run folders are compared as they are, without --methods, --set, --seconds")
        _compare_folders(console, [Path(name) for name in what], out, overwrite)
        return
    _check_single(what)
    chosen = _parse_methods(methods)
    given = _settings_by_method(chosen, arguments.settings(settings, "--set"))
    for one in chosen:
        one.start(given[one.name])
    options = arguments.settings(problem_settings, "--problem-set")
    arguments.check_problem(what[0], options)
    _, seconds = arguments.budget(None, DEFAULT_SECONDS if seconds is None else seconds)
    name = Path(what[0]).stem if what[0].endswith(".toml") else what[0]
    folder = arguments.folder(out, f"{name}-compare", overwrite, *_MARKS)
    try:
        running = arguments.use_variant(variant)
        problem = arguments.open_problem(what[0], options)
        introduce(console, problem, running)
        command = shlex.join(context.find_root().obj or ["unrender"])
        plans = [  # methods take turns, so that a machine that slows down slows all of them
            Plan(problem, one, given[one.name], None, seconds, number, final_spp, command, options)
            for number, one in itertools.product(range(seed, seed + seeds), chosen)
        ]
        directories, status = _run_all(console, plans, folder)
    finally:
        arguments.remove_if_empty(folder)
    if directories:
        _report(console, directories, folder)
    if status:
        raise typer.Exit(status)


def _report(console: Console, directories: Sequence[Path], folder: Path) -> None:
    """Compare runs made here."""
    comparison, notices = report.load_comparison(directories)
    _print_comparison(console, comparison)
    console.print("Time of compilation is left out for every method alike.")
    console.print(f"page: {_plain(str(report.write_comparison(comparison, notices, folder)))}", soft_wrap=True)


def _check_single(what: Sequence[str]) -> None:
    """Raise `InputError` unless one problem is given."""
    if len(what) > 1:
        missing = next(name for name in what if not Path(name).is_dir())
        raise InputError(f"{missing}: no such run folder (give run folders, or one problem)")


def _compare_folders(console: Console, directories: Sequence[Path], out: Path | None, overwrite: bool) -> None:
    """Compare runs made earlier."""
    folder = arguments.folder(out, "compare", overwrite, *_MARKS)
    try:
        comparison, notices = report.load_comparison(directories)
        page = report.write_comparison(comparison, notices, folder)
    finally:
        arguments.remove_if_empty(folder)
    _print_comparison(console, comparison)
    for notice in notices:
        console.print(f"note: {_plain(notice)}", soft_wrap=True)
    console.print(f"page: {_plain(str(page))}", soft_wrap=True)


def _run_all(console: Console, plans: Sequence[Plan], folder: Path) -> tuple[list[Path], int]:
    """Carry out the plans until one is interrupted.

    Returns the run folders of runs that took a step, and the exit status: of the one that was interrupted, or of one that failed, else 0.
    """
    directories: list[Path] = []
    status = 0
    for plan in plans:
        console.print(f"[bold]{plan.method.name}[/], seed {plan.seed}, {plan.seconds:g} s")
        directory = folder / f"{plan.method.name}-seed{plan.seed}"
        result = execute(plan, directory, console)
        if result.steps:
            directories.append(directory)
        status = exit_status(result) or status
        if result.status == "interrupted":
            break
    return directories, status


def _parse_methods(names: str | None) -> list[Method]:
    if names is None:
        return [method("plain"), method("rcv")]
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


def _print_comparison(console: Console, comparison: Comparison) -> None:
    """The median over each method's runs, and the range: of every metric, and of the last pictures."""
    parameters = [metric for metric in comparison.metrics if metric.name != "loss"]
    for metric in parameters or comparison.metrics:
        console.print(f"[bold]{_plain(metric.title)}[/]", soft_wrap=True)
        first = metric.methods[comparison.groups[0].label]
        times = [f"at {formatting.duration(moment.seconds)}" for moment in first.moments]
        table = _table("method", "runs", *times, f"after {formatting.count(comparison.samples)} paths")
        for group in comparison.groups:
            outcome = metric.methods[group.label]
            cells = [moment.error for moment in (*outcome.moments, outcome.at_samples[-1])]
            table.add_row(_plain(group.label), str(len(group.runs)), *map(_spread, cells))
        console.print(table)
    if comparison.image_error[comparison.groups[0].label].median is not None:
        console.print("[bold]Last pictures, each run's at its own end[/]")
        table = _table("method", *comparison.images)
        for group in comparison.groups:
            table.add_row(_plain(group.label), *(_spread(of[group.label]) for of in comparison.images.values()))
        console.print(table)
        if not has_flip():
            console.print("FLIP is left out: its package is missing (pip install 'unrender[flip]')", markup=False)


def _plain(text: str) -> str:
    """Text of a run folder, without marks for rich; in a column as wide as what is printed."""
    return escape(visible(text))


def _table(*headings: str) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for heading in headings:
        table.add_column(_plain(heading), overflow="fold")
    return table


def _spread(of: Spread) -> str:
    if of.median is None:
        return "–"
    middle = formatting.number(of.median)
    low, high = formatting.number(of.low), formatting.number(of.high)
    return middle if low == high else f"{middle} ({low}–{high})"
